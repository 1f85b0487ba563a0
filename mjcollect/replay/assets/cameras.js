// Three cameras: orbit, chase (behind the followed UAV, out of boxes) and top.

const OVERVIEW = [1, .82, -.72]; // The orbit camera looks along this at first, as videos do.
const BOOM = 48; // The chase camera follows at so many radii of the UAV.
const BEHIND = 17 * Math.PI / 180; // From straight behind it looks down by this.
const TILT = [-25 * Math.PI / 180, 78 * Math.PI / 180];
const SWINGS = [0, -35, 35, -70, 70, -110, 110].map((angle) => angle * Math.PI / 180);
const LIFTS = [0, 20, 40, 58].map((angle) => angle * Math.PI / 180);

const BELOW = 88, ABOVE = 60; // Bars and names take so many pixels of the window's height.

class Cameras {
  constructor(world, canvas, changed) {
    this.world = world;
    this.changed = changed;
    this.orbit = this.withControls(45, canvas, {});
    this.top = this.withControls(30, canvas, { minPolarAngle: 0, maxPolarAngle: 0, enableRotate: false });
    this.top.controls.mouseButtons = { LEFT: 2, MIDDLE: 1, RIGHT: 2 }; // pan, dolly, pan
    this.top.controls.touches = { ONE: 1, TWO: 2 }; // pan, dolly and pan
    this.orbit.controls.maxPolarAngle = .497 * Math.PI;
    this.chase = new THREE.PerspectiveCamera(55, 1, .1, 10);
    this.chase.up.set(0, 0, 1);
    this.offset = { swing: 0, lift: 0, reach: null, wanted: [0, 0], decided: -1 };
    this.hand = { turn: 0, lift: 0, zoom: 1 };
    this.name = "orbit";
    this.listen(canvas);
  }

  withControls(fov, canvas, settings) {
    const camera = new THREE.PerspectiveCamera(fov, 1, .1, 10);
    camera.up.set(0, 0, 1);
    camera.controls = new THREE.OrbitControls(camera, canvas);
    Object.assign(camera.controls, { zoomToCursor: true, ...settings });
    camera.controls.minDistance = 4 * this.world.scene.radius;
    camera.controls.maxDistance = 6 * this.world.diagonal;
    camera.controls.addEventListener("change", () => this.changed());
    return camera;
  }

  get active() {
    return this[this.name];
  }

  use(name) {
    this.name = name;
    this.orbit.controls.enabled = name === "orbit";
    this.top.controls.enabled = name === "top";
    this.offset.reach = null;
  }

  /** Fits orbit and top to the window, and to the bounds if they were not touched yet. */
  resize(width, height, frame) {
    for (const camera of [this.orbit, this.chase, this.top]) {
      camera.aspect = width / height;
      // The middle of what is seen is the middle of what is free.
      const down = { [this.orbit.uuid]: BELOW / 2, [this.top.uuid]: (BELOW - ABOVE) / 2 }[camera.uuid] ?? 0;
      camera.setViewOffset(width, height, 0, down, width, height);
    }
    if (!frame) return;
    this.frame(this.orbit, new THREE.Vector3(...OVERVIEW), .98 - BELOW / height);
    this.frame(this.top, new THREE.Vector3(0, 1e-5, -1), .98 - (BELOW + ABOVE) / height);
  }

  /** Puts a camera as near as all of the bounds can be seen. */
  frame(camera, direction, fill) {
    const { centre, low, high } = this.world;
    const ahead = direction.clone().normalize();
    const right = ahead.clone().cross(camera.up).normalize(), up = right.clone().cross(ahead);
    const tangent = Math.tan(camera.fov * Math.PI / 360) * fill;
    let back = 0;
    for (let k = 0; k < 8; k++) {
      const corner = new THREE.Vector3(
        k & 1 ? high.x : low.x, k & 2 ? high.y : low.y, k & 4 ? high.z : low.z).sub(centre);
      const wide = Math.abs(corner.dot(right)) / (tangent * camera.aspect);
      back = Math.max(back, Math.max(wide, Math.abs(corner.dot(up)) / tangent) - corner.dot(ahead));
    }
    camera.position.copy(centre).addScaledVector(ahead, -back);
    camera.controls.target.copy(centre);
    camera.controls.update();
  }

  listen(canvas) {
    let held = null;
    canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; });
    window.addEventListener("pointerup", () => { held = null; });
    window.addEventListener("pointermove", (event) => {
      if (held === null || this.name !== "chase") return;
      this.hand.turn -= (event.clientX - held[0]) * .006;
      this.hand.lift = Math.min(Math.max(this.hand.lift + (event.clientY - held[1]) * .005, -1.2), 1.2);
      held = [event.clientX, event.clientY];
      this.changed();
    });
    canvas.addEventListener("wheel", (event) => {
      if (this.name !== "chase") return;
      event.preventDefault();
      this.hand.zoom = Math.min(Math.max(this.hand.zoom * Math.exp(event.deltaY * .001), .25), 8);
      this.changed();
    }, { passive: false });
  }

  /** Moves the chase camera behind a UAV; `dt` are seconds since the last frame, or it jumps. */
  follow(uav, dt, jump) {
    const { offset, hand, world } = this, { state } = uav;
    const boom = BOOM * world.scene.radius * hand.zoom;
    const at = uav.model.position, tilt = BEHIND - .6 * state.climb;
    const direction = (swing, lift) => {
      const azimuth = state.heading + Math.PI + swing + hand.turn;
      const elevation = Math.min(Math.max(tilt + lift + hand.lift, TILT[0]), TILT[1]);
      const flat = Math.cos(elevation);
      return new THREE.Vector3(flat * Math.cos(azimuth), flat * Math.sin(azimuth), Math.sin(elevation));
    };
    offset.decided += dt;
    if (jump || offset.decided > .15) {
      offset.decided = 0;
      let best = Infinity;
      for (const swing of SWINGS)
        for (const lift of LIFTS) {
          const way = direction(swing, lift);
          const clear = world.clearance(at, way, .9 * world.scene.radius, boom) / boom;
          const below = at.z + boom * way.z < world.low.z + .01 * boom;
          const turn = Math.abs(swing - offset.wanted[0]) + Math.abs(lift - offset.wanted[1]);
          const cost = (swing / .7) ** 2 + (lift / .5) ** 2 + 12 * (1 - clear) ** 2 +
            (clear < .2 ? 30 : 0) + (below ? 4 : 0) + (jump ? 0 : turn);
          if (cost < best) { best = cost; offset.next = [swing, lift]; }
        }
      offset.wanted = offset.next;
    }
    const share = jump ? 1 : 1 - Math.exp(-dt / .35);
    offset.swing += share * (offset.wanted[0] - offset.swing);
    offset.lift += share * (offset.wanted[1] - offset.lift);
    const way = direction(offset.swing, offset.lift);
    const clear = Math.max(world.clearance(at, way, .9 * world.scene.radius, boom), .08 * boom);
    const slow = offset.reach === null || jump ? clear : offset.reach + share * (clear - offset.reach);
    offset.reach = Math.min(clear, slow); // It comes nearer at once and goes away slowly.
    this.chase.position.copy(at).addScaledVector(way, offset.reach);
    const floor = world.low.z + .02 * boom;
    if (this.chase.position.z < floor) this.chase.position.z = floor;
    this.chase.lookAt(at);
  }

  /** Sets near and far planes of the active camera, so that depths are told apart. */
  setPlanes() {
    const camera = this.active, { diagonal, scene } = this.world;
    const away = this.name === "chase"
      ? .5 * this.offset.reach : camera.position.distanceTo(camera.controls.target);
    camera.near = Math.max(.02 * away, .1 * scene.radius);
    camera.far = 6 * diagonal + 2 * away;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }
}
