// What flies: UAVs with their tracks, and boxes that move.

const GRAVITY = 9.81; // A hovering quadrotor pushes against this (m/s²).
const TURN = .12; // A quadrotor turns in about this time (s); commands jump from slot to slot.
const SPAN = 2.6; // A UAV is drawn so many of its radii wide, or wider to be seen.

/** Returns a quadrotor one metre wide, its nose along x, in a colour. */
function quadrotor(colour) {
  const group = new THREE.Group();
  const paint = new THREE.MeshLambertMaterial({ color: colour });
  const dark = new THREE.MeshLambertMaterial({ color: 0x2a323b });
  const blade = new THREE.MeshLambertMaterial({ color: 0xf4f6f8, transparent: true, opacity: .72 });
  const add = (geometry, material, x = 0, y = 0, z = 0) => {
    const mesh = new THREE.Mesh(geometry, material);
    mesh.position.set(x, y, z);
    group.add(mesh);
    return mesh;
  };
  add(new THREE.SphereGeometry(.17, 20, 14), paint).scale.set(1.25, .95, .62);
  add(new THREE.ConeGeometry(.075, .2, 16).rotateZ(-Math.PI / 2), dark, .27);
  for (const angle of [1, 3, 5, 7].map((k) => k * Math.PI / 4)) {
    const x = .36 * Math.cos(angle), y = .36 * Math.sin(angle);
    add(new THREE.CylinderGeometry(.028, .028, .36, 8), dark, x / 2, y / 2).rotation.z = angle + Math.PI / 2;
    add(new THREE.CylinderGeometry(.04, .04, .09, 10).rotateX(Math.PI / 2), paint, x, y, .03);
    add(new THREE.CylinderGeometry(.19, .19, .012, 28).rotateX(Math.PI / 2), blade, x, y, .085);
    add(new THREE.TorusGeometry(.19, .014, 6, 28), dark, x, y, .085);
  }
  return group;
}

/** The flown path: bright as far as it is flown, faint as a whole, also behind boxes. */
class Track {
  constructor(flight, world, ramp) {
    this.flight = flight;
    const rows = flight.rows, kept = this.kept = corners(flight, .2 * world.scene.radius, world.scene.vMax / 40);
    const places = [], speeds = [], own = [];
    const colour = new THREE.Color(flight.colour), at = new THREE.Color();
    for (const k of kept) {
      places.push(rows[k * COLUMNS + 1], rows[k * COLUMNS + 2], rows[k * COLUMNS + 3]);
      at.copy(rampColour(ramp, flight.speeds[k] / world.scene.vMax));
      speeds.push(at.r, at.g, at.b);
      own.push(colour.r, colour.g, colour.b);
    }
    this.speeds = speeds;
    this.own = own;
    this.whole = this.line(places, { linewidth: 1.5, opacity: .45, transparent: true, depthTest: false });
    this.flown = this.line(places, { linewidth: 3.5 });
    this.colour(true);
    world.three.add(this.whole, this.flown);
  }

  line(places, looks) {
    const geometry = new THREE.LineGeometry();
    geometry.setPositions(places);
    const line = new THREE.Line2(geometry, new THREE.LineMaterial({ vertexColors: true, ...looks }));
    line.frustumCulled = false;
    line.raycast = () => {};
    return line;
  }

  colour(bySpeed) {
    for (const line of [this.whole, this.flown]) line.geometry.setColors(bySpeed ? this.speeds : this.own);
  }

  /** Shows it as far as a row, and from there to where the UAV is. */
  show(row, x) {
    let low = 0, high = this.kept.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.kept[middle] <= row) low = middle;
      else high = middle - 1;
    }
    // The last piece ends at the UAV; the place that it ends at otherwise is put back.
    const { data } = this.flown.geometry.attributes.instanceStart;
    const places = data.array, next = Math.min(low + 1, this.kept.length - 1);
    if (this.cut !== undefined) places.set(this.cut.place, this.cut.at);
    const end = 6 * (next - 1) + 3;
    this.cut = next > low ? { at: end, place: places.slice(end, end + 3) } : undefined;
    if (this.cut !== undefined) places.set(x, end);
    data.needsUpdate = true;
    this.flown.geometry.instanceCount = next;
  }
}

/** Returns the rows that a track needs, so that no place is off by more than `off` m, and no speed
 * by more than `slow` m/s (Douglas and Peucker).
 */
function corners(flight, off, slow) {
  const { rows, speeds, count } = flight, kept = new Set([0, count - 1]), todo = [[0, count - 1]];
  while (todo.length > 0) {
    const [first, last] = todo.pop(), a = first * COLUMNS, b = last * COLUMNS;
    const step = [1, 2, 3].map((axis) => rows[b + axis] - rows[a + axis]);
    const square = step.reduce((sum, part) => sum + part * part, 0);
    let worst = 1, at = -1;
    for (let k = first + 1; k < last; k++) {
      const c = k * COLUMNS;
      const out = [1, 2, 3].map((axis) => rows[c + axis] - rows[a + axis]);
      const along = square > 0 ? out.reduce((sum, part, i) => sum + part * step[i], 0) / square : 0;
      const share = Math.min(Math.max(along, 0), 1);
      const away = Math.hypot(...out.map((part, i) => part - share * step[i])) / off;
      const wrong = Math.abs(speeds[k] - speeds[first] - share * (speeds[last] - speeds[first])) / slow;
      if (Math.max(away, wrong) > worst) { worst = Math.max(away, wrong); at = k; }
    }
    if (at > 0) { kept.add(at); todo.push([first, at], [at, last]); }
  }
  const sorted = [...kept].sort((one, two) => one - two);
  return sorted.length > 1 ? sorted : [0, 0];
}

function rampColour(ramp, share) {
  const at = Math.min(Math.max(share, 0), 1) * (ramp.length - 1), k = Math.min(Math.floor(at), ramp.length - 2);
  return new THREE.Color(ramp[k]).lerp(new THREE.Color(ramp[k + 1]), at - k);
}

/** One flight as it is drawn. */
class Uav {
  constructor(flight, world, ramp) {
    this.flight = flight;
    this.world = world;
    this.state = freshState();
    this.before = freshState();
    this.after = freshState();
    this.track = new Track(flight, world, ramp);
    this.model = quadrotor(flight.colour);
    this.model.traverse((part) => { part.userData.uav = this; });
    this.ring = new THREE.Mesh(
      new THREE.RingGeometry(.82, 1, 40),
      new THREE.MeshBasicMaterial({ color: flight.colour, depthTest: false, transparent: true, opacity: .9 }),
    );
    this.ring.raycast = () => {};
    this.ring.renderOrder = 3;
    this.plumb = this.makePlumb();
    world.three.add(this.model, this.ring, this.plumb);
  }

  /** A line from the UAV straight down to the ground shows how high it is. */
  makePlumb() {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6), 3));
    const line = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({
      color: this.flight.colour, transparent: true, opacity: .6,
    }));
    line.frustumCulled = false;
    line.raycast = () => {};
    return line;
  }

  place(t) {
    const { flight, state } = this;
    const end = Math.min(t, flight.duration);
    flight.at(end, state);
    this.model.position.set(...state.x);
    const from = Math.max(end - TURN, 0), to = Math.min(end + TURN, flight.duration);
    flight.at(from, this.before);
    flight.at(to, this.after);
    const span = Math.max(to - from, 1e-6);
    const push = state.v.map((_, axis) => (this.after.v[axis] - this.before.v[axis]) / span);
    const up = new THREE.Vector3(push[0], push[1], push[2] + GRAVITY).normalize();
    const left = new THREE.Vector3(-Math.sin(state.heading), Math.cos(state.heading), 0);
    const nose = left.clone().cross(up).normalize();
    left.crossVectors(up, nose);
    this.model.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(nose, left, up));
    this.track.show(flight.rowAt(end) + (end >= flight.duration ? 1 : 0), state.x);
    const ends = this.plumb.geometry.attributes.position;
    ends.setXYZ(0, ...state.x);
    ends.setXYZ(1, state.x[0], state.x[1], this.world.low.z);
    ends.needsUpdate = true;
  }

  /** Makes it large enough to be seen; `pixel` is a pixel's size (m) at a distance of 1 m. */
  fit(camera, pixel, near) {
    const away = camera.position.distanceTo(this.model.position);
    const size = Math.max(SPAN * this.world.scene.radius, (near ? 84 : 30) * pixel * away);
    this.model.scale.setScalar(size);
    this.ring.visible = !near;
    this.track.whole.material.depthTest = near;
    this.ring.position.copy(this.model.position);
    this.ring.quaternion.copy(camera.quaternion);
    this.ring.scale.setScalar(Math.max(.75 * size, 17 * pixel * away));
  }
}

/** A box that moves to and fro. */
class Mover {
  constructor(box, name, colour, world) {
    this.box = box;
    this.centre = [0, 0, 0];
    this.mesh = new THREE.Mesh(
      new THREE.BoxGeometry(...box.size), new THREE.MeshLambertMaterial({ color: colour }),
    );
    this.mesh.userData.mover = name;
    world.three.add(this.mesh);
  }

  place(t) {
    this.mesh.position.set(...movingCentre(this.box, t, this.centre));
  }
}
