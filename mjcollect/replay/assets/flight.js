// Recorded flights: decoded, and asked for the state at any time.

/** Returns the float32 numbers of base64 text, as payload.py encodes them. */
function decode(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

const COLUMNS = 8; // time, position, velocity, length flown so far

/** One UAV's flight. Times are in s, lengths in m. */
class Flight {
  constructor(part, run) {
    Object.assign(this, part);
    this.run = run;
    this.rows = decode(part.rows);
    this.count = this.rows.length / COLUMNS;
    this.colour = part.colour ?? run.colour;
    this.speeds = new Float32Array(this.count);
    for (let k = 0; k < this.count; k++) {
      const at = k * COLUMNS;
      this.speeds[k] = Math.hypot(this.rows[at + 4], this.rows[at + 5], this.rows[at + 6]);
    }
    this.findCourse();
  }

  /** Returns the last row at or before a time, but never the last of all if there are two. */
  rowAt(t) {
    let low = 0, high = Math.max(this.count - 2, 0);
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.rows[middle * COLUMNS] <= t) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  /** Puts the state at a time into `state`: x, v (arrays of 3), speed, length, heading, tilt. */
  at(t, state) {
    const k = this.rowAt(t), one = k * COLUMNS, two = Math.min(k + 1, this.count - 1) * COLUMNS;
    const rows = this.rows, step = rows[two] - rows[one];
    const u = step > 0 ? Math.min(Math.max((t - rows[one]) / step, 0), 1) : 0;
    const u2 = u * u, u3 = u2 * u;
    for (let axis = 0; axis < 3; axis++) {
      const x0 = rows[one + 1 + axis], x1 = rows[two + 1 + axis];
      const v0 = rows[one + 4 + axis], v1 = rows[two + 4 + axis];
      // Hermite's cubic goes through both places with both velocities.
      state.x[axis] = (2 * u3 - 3 * u2 + 1) * x0 + (3 * u2 - 2 * u3) * x1 +
        step * ((u3 - 2 * u2 + u) * v0 + (u3 - u2) * v1);
      state.v[axis] = v0 + u * (v1 - v0);
    }
    state.speed = this.speeds[k] + u * (this.speeds[Math.min(k + 1, this.count - 1)] - this.speeds[k]);
    state.length = rows[one + 7] + u * (rows[two + 7] - rows[one + 7]);
    const next = Math.min(k + 1, this.count - 1);
    state.heading = this.headings[k] + u * (this.headings[next] - this.headings[k]);
    state.climb = this.climbs[k] + u * (this.climbs[next] - this.climbs[k]);
    return state;
  }

  /** Finds headings and angles of climb (rad), smooth and known before they are needed. */
  findCourse() {
    const headings = new Float64Array(this.count), climbs = new Float64Array(this.count);
    const least = 1e-3 * this.speeds.reduce((fastest, speed) => Math.max(fastest, speed), 1e-9);
    let first = -1;
    for (let k = 0; k < this.count; k++) {
      const at = k * COLUMNS, vx = this.rows[at + 4], vy = this.rows[at + 5];
      const sideways = Math.hypot(vx, vy);
      climbs[k] = Math.atan2(this.rows[at + 6], Math.max(sideways, 0.05 * this.speeds[k], 1e-9));
      if (sideways > least) {
        let angle = Math.atan2(vy, vx);
        if (first < 0) { first = k; headings.fill(angle, 0, k); }
        else angle = headings[k - 1] + wrapped(angle - headings[k - 1]);
        headings[k] = angle;
      } else if (first >= 0) headings[k] = headings[k - 1];
    }
    const step = this.count > 1 ? this.duration / (this.count - 1) : 1;
    this.headings = smoothed(headings, 0.5 / step);
    this.climbs = smoothed(climbs, 0.6 / step);
  }

  /** Returns how many of its stops it has reached at a time. */
  reached(t) {
    let count = 0;
    while (count < this.stops.length && this.stops[count].t !== null && this.stops[count].t <= t + 1e-6) count++;
    return count;
  }

  /** Returns the time from which an item counts as collected; Infinity if it never is. */
  collectedAt(item) {
    if (this.before.includes(item)) return -1;
    const stop = this.stops.find((each) => each.node === item);
    return stop === undefined || stop.t === null ? Infinity : stop.t;
  }

  /** Returns whether the shield changes the command at a time. */
  shielded(t) {
    return this.shield.some(([begin, end]) => begin <= t && t < end);
  }
}

function wrapped(angle) {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}

/** Returns values smoothed by three means over windows, which is nearly a Gaussian. */
function smoothed(values, sigma) {
  const half = Math.max(1, Math.round(sigma * 0.9));
  let from = values;
  for (let pass = 0; pass < 3; pass++) {
    const sums = new Float64Array(from.length + 1);
    for (let k = 0; k < from.length; k++) sums[k + 1] = sums[k] + from[k];
    const to = new Float64Array(from.length);
    for (let k = 0; k < from.length; k++) {
      const reach = Math.min(half, k, from.length - 1 - k);
      to[k] = (sums[k + reach + 1] - sums[k - reach]) / (2 * reach + 1);
    }
    from = to;
  }
  return from;
}

function freshState() {
  return { x: [0, 0, 0], v: [0, 0, 0], speed: 0, length: 0, heading: 0, climb: 0 };
}

/** Puts the centre of a box that moves to and fro along its path into `to`; see scene/moving.py. */
function movingCentre(box, t, to) {
  const pieces = box.path.slice(1).map((point, k) => Math.hypot(...point.map((c, i) => c - box.path[k][i])));
  const whole = pieces.reduce((sum, piece) => sum + piece, 0);
  const gone = 2 * whole * (box.phase ?? 0) + box.speed * t;
  let at = whole - Math.abs((((gone % (2 * whole)) + 2 * whole) % (2 * whole)) - whole);
  let k = 0;
  while (k < pieces.length - 1 && at > pieces[k]) at -= pieces[k++];
  const share = Math.min(at / pieces[k], 1);
  for (let axis = 0; axis < 3; axis++)
    to[axis] = box.path[k][axis] + share * (box.path[k + 1][axis] - box.path[k][axis]);
  return to;
}

function nodeName(node) {
  return node >= 0 ? `item ${node}` : node === -1 ? "depot" : `depot ${-1 - node}`;
}
