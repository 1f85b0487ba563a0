// Names: of what is under the cursor, and labels beside nodes and UAVs.

const MOST_LABELS = 80;

class Hover {
  constructor(world, uavs, movers, canvas, tip) {
    Object.assign(this, { world, uavs, movers, tip });
    this.ray = new THREE.Raycaster();
    this.pointer = null;
    this.moved = false;
    this.box = null;
    canvas.addEventListener("pointermove", (event) => {
      this.pointer = event.buttons === 0 ? [event.clientX, event.clientY] : null;
      this.moved = true;
    });
    canvas.addEventListener("pointerleave", () => { this.pointer = null; this.moved = true; });
  }

  /** Names what is under the cursor at a time; returns whether another box is to be marked.
   *
   * `describe` gives a headline and a line below it.
   */
  show(camera, t, describe) {
    this.moved = false;
    const found = this.pointer === null ? null : this.find(camera);
    const changed = this.mark(found?.box ?? null);
    this.tip.hidden = found === null;
    if (found === null) return changed;
    const [head, more] = describe(found, t);
    const small = document.createElement("small");
    small.textContent = more;
    this.tip.replaceChildren(head, ...(more ? [small] : []));
    const [x, y] = this.pointer, { offsetWidth, offsetHeight } = this.tip;
    const left = x + 16 + offsetWidth > innerWidth ? x - 12 - offsetWidth : x + 16;
    const top = Math.min(Math.max(y + 14, 4), innerHeight - offsetHeight - 4);
    this.tip.style.left = `${left}px`;
    this.tip.style.top = `${top}px`;
    return changed;
  }

  find(camera) {
    const [x, y] = this.pointer;
    this.ray.setFromCamera(new THREE.Vector2(2 * x / innerWidth - 1, 1 - 2 * y / innerHeight), camera);
    const targets = [
      ...this.uavs.map((uav) => uav.model), ...this.world.nodes.map((node) => node.mesh),
      ...this.movers.map((mover) => mover.mesh),
    ];
    const hit = this.ray.intersectObjects(targets, true)[0];
    const { origin, direction } = this.ray.ray;
    const { box } = this.world.firstBox(origin, direction, 0, hit?.distance ?? Infinity, true);
    return box === null ? hit?.object.userData ?? null : { box };
  }

  mark(box) {
    if (box === this.box) return false;
    if (this.box !== null) this.world.pick(this.box, false);
    if (box !== null) this.world.pick(box, true);
    this.box = box;
    return true;
  }
}

/** Labels that follow points of the scene on the screen. */
class Labels {
  constructor(holder, world, uavs) {
    this.holder = holder;
    const nodes = world.nodes.length > MOST_LABELS ? [] : world.nodes;
    this.labels = [
      ...nodes.map((node) => ({ ...this.make(node.node < 0 ? nodeName(node.node) : `${node.node}`), node })),
      ...(uavs.length > 1 ? uavs : []).map((uav) => ({ ...this.make(uav.label), uav })),
    ];
    this.point = new THREE.Vector3();
  }

  make(text) {
    const element = document.createElement("div");
    element.className = "label";
    element.append(document.createElement("span"));
    element.firstChild.textContent = text;
    this.holder.append(element);
    return { element };
  }

  /** Puts them where the camera sees what they name; one UAV's may be hidden. */
  show(camera, width, height, hidden) {
    for (const { element, node, uav } of this.labels) {
      this.point.copy(node ? node.at : uav.model.position).project(camera);
      const { x, y, z } = this.point;
      const shown = uav !== hidden && z > -1 && z < 1 && Math.abs(x) < 1.05 && Math.abs(y) < 1.05;
      const display = shown ? "" : "none";
      if (element.style.display !== display) element.style.display = display;
      if (!shown) continue;
      const colour = node ? node.look.colour : uav.flight.colour;
      if (element.dataset.colour !== colour) element.style.color = element.dataset.colour = colour;
      const lift = node ? 12 : -34 - 18 * (uav.run % 3);
      const left = (x + 1) / 2 * width, top = (1 - y) / 2 * height + lift;
      element.style.transform = `translate(${left.toFixed(1)}px,${top.toFixed(1)}px) translateX(-50%)`;
    }
  }
}
