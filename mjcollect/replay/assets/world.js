// What stands: ground, boxes, bounds, depots, items.

const THEMES = {
  light: { sky: 0xdfe7ef, ground: 0xc3ccc8, line: 0xb0bab7, edge: 0x5a6672, bound: 0x8a97a5, shade: 1.08 },
  dark: { sky: 0x141b24, ground: 0x222c36, line: 0x303c48, edge: 0x0c1117, bound: 0x5c6a78, shade: .62 },
};

// At most three faces of a box are seen at once, those towards the camera, so only these are drawn:
// the corner at (1, 1, 1) of a unit box, mirrored to the camera's side. Processors without a
// graphics card draw twice as fast that way. Colours are those of the screen: nothing is converted.
const BOX_VERTEX = `
  attribute vec3 centre, size, tint; attribute vec2 turn; attribute float picked;
  uniform float shade;
  varying vec2 vFace; varying vec3 vColour; varying float vHeight;
  void main() {
    vec3 away = cameraPosition - centre;
    vec3 seen = vec3(turn.x * away.x + turn.y * away.y, turn.x * away.y - turn.y * away.x, away.z);
    vec3 side = mix(vec3(-1.), vec3(1.), step(0., seen));
    vec3 place = position * side, at = place * size, face = normal * side;
    vec2 way = vec2(turn.x * face.x - turn.y * face.y, turn.y * face.x + turn.x * face.y);
    float sun = max(dot(vec3(way, face.z), vec3(-.406, -.305, .863)), 0.);
    vColour = tint * (.74 + .16 * sun + .08 * face.z + .05 * way.x) * shade;
    vColour = mix(vColour, vec3(1., .78, .25), picked * .55);
    vFace = uv;
    vHeight = place.z + .5;
    vec2 flat_ = vec2(turn.x * at.x - turn.y * at.y, turn.y * at.x + turn.x * at.y);
    gl_Position = projectionMatrix * (viewMatrix * vec4(centre + vec3(flat_, at.z), 1.));
  }`;
const BOX_FRAGMENT = `
  uniform vec3 edge; uniform float opacity;
  varying vec2 vFace; varying vec3 vColour; varying float vHeight;
  void main() {
    vec2 pixel = fwidth(vFace), away = (.5 - abs(vFace - .5)) / pixel;
    float line = clamp(1.4 - min(away.x, away.y), 0., 1.);
    line *= clamp(.06 / max(pixel.x, pixel.y) - .2, 0., 1.);  // none on boxes of a few pixels
    vec3 colour = vColour * (.86 + .14 * min(vHeight * 1.2, 1.));
    gl_FragColor = vec4(mix(colour, edge, line * .6), opacity + line * (1. - opacity) * .5);
  }`;

const GROUND_VERTEX = `
  varying vec2 vPlace;
  void main() { vPlace = position.xy; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.); }`;
const GROUND_FRAGMENT = `
  uniform vec3 sky, ground, line; uniform vec2 low, high; uniform float cell, fade;
  varying vec2 vPlace;
  void main() {
    vec2 centre = .5 * (low + high);
    vec2 at = (vPlace - low) / cell, pixel = fwidth(at);
    vec2 away = abs(at - round(at)) / max(pixel, 1e-6);
    vec2 fine = (1. - smoothstep(.5, 1.5, away)) * (1. - smoothstep(.08, .30, pixel));
    vec2 inside = step(low, vPlace) * step(vPlace, high);
    vec3 colour = mix(ground, line, max(fine.x, fine.y) * .9);
    colour = mix(mix(colour, sky, .35), colour, inside.x * inside.y);
    float far = length(vPlace - centre) / fade;
    gl_FragColor = vec4(mix(colour, sky, smoothstep(.35, 1., far)), 1.);
  }`;

/** Returns a colour for these shaders, which do not convert it. */
function plain(hex) {
  return new THREE.Color().set(hex).convertLinearToSRGB();
}

const FACES = threeFaces();

/** Returns places, normals and face coordinates of the 12 corners of three faces of a unit box. */
function threeFaces() {
  const corners = [];
  for (let axis = 0; axis < 3; axis++)
    for (const uv of [[0, 0], [1, 0], [1, 1], [0, 1]]) {
      const position = [0, 0, 0], normal = [0, 0, 0];
      position[axis] = .5;
      position[(axis + 1) % 3] = uv[0] - .5;
      position[(axis + 2) % 3] = uv[1] - .5;
      normal[axis] = 1;
      corners.push({ position, normal, uv });
    }
  return corners;
}

/** Everything of a scene that does not move. */
class World {
  constructor(scene, colours, three) {
    this.scene = scene;
    this.colours = colours;
    const [low, high] = scene.bounds;
    this.low = new THREE.Vector3(...low);
    this.high = new THREE.Vector3(...high);
    this.centre = this.low.clone().add(this.high).multiplyScalar(.5);
    this.size = this.high.clone().sub(this.low);
    this.diagonal = this.size.length();
    this.three = three;
    this.readBoxes();
    this.addGround();
    this.solid = this.addBoxes(this.boxes.filter((box) => !box.noFly), 1);
    this.zones = this.addBoxes(this.boxes.filter((box) => box.noFly), .3);
    this.addBounds();
    this.nodes = [
      ...scene.depots.map((at, k) => this.addDepot(at, -1 - k)),
      ...scene.items.map((at, k) => this.addItem(at, k)),
    ];
    three.add(new THREE.HemisphereLight(0xffffff, 0x9aa6b0, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(-.4, -.3, .85);
    three.add(sun);
  }

  readBoxes() {
    const rows = decode(this.scene.boxes), noFly = new Set(this.scene.noFly);
    this.boxes = [];
    for (let k = 0; k * 7 < rows.length; k++) {
      const row = rows.subarray(k * 7, k * 7 + 7), yaw = row[6] * Math.PI / 180;
      this.boxes.push({
        number: k, noFly: noFly.has(k), yaw: row[6],
        centre: [row[0], row[1], row[2]], size: [row[3], row[4], row[5]],
        cos: Math.cos(yaw), sin: Math.sin(yaw),
      });
    }
  }

  addGround() {
    const wide = Math.max(this.size.x, this.size.y), fade = 2.6 * wide;
    const geometry = new THREE.PlaneGeometry(2 * fade, 2 * fade);
    geometry.translate(this.centre.x, this.centre.y, 0);
    this.ground = new THREE.ShaderMaterial({
      vertexShader: GROUND_VERTEX, fragmentShader: GROUND_FRAGMENT,
      uniforms: {
        sky: { value: new THREE.Color() }, ground: { value: new THREE.Color() },
        line: { value: new THREE.Color() }, fade: { value: fade },
        low: { value: new THREE.Vector2(this.low.x, this.low.y) },
        high: { value: new THREE.Vector2(this.high.x, this.high.y) },
        cell: { value: this.cell() },
      },
    });
    const mesh = new THREE.Mesh(geometry, this.ground);
    mesh.position.z = this.low.z - 1e-3 * this.diagonal;
    this.three.add(mesh);
  }

  /** Returns the side (m) of the ground's cells: 1, 2 or 5 times a power of ten, 10 to 25 of them. */
  cell() {
    const raw = Math.max(this.size.x, this.size.y) / 20, power = 10 ** Math.floor(Math.log10(raw));
    return power * ([1, 2, 5].findLast((step) => step * power <= raw * 1.0001) ?? 1);
  }

  addBoxes(boxes, opacity) {
    if (boxes.length === 0) return null;
    const material = new THREE.ShaderMaterial({
      vertexShader: BOX_VERTEX, fragmentShader: BOX_FRAGMENT,
      transparent: opacity < 1, depthWrite: opacity === 1, side: 2, // mirrored faces turn round
      uniforms: {
        edge: { value: new THREE.Color() }, shade: { value: 1 }, opacity: { value: opacity },
      },
    });
    // One mesh of all boxes: software draws instances one by one, which takes far longer.
    const geometry = new THREE.BufferGeometry(), shades = this.colours.boxes;
    const add = (name, width, numbers) => geometry.setAttribute(name, new THREE.BufferAttribute(
      new Float32Array(boxes.flatMap((box) => FACES.flatMap((corner) => numbers(box, corner)))), width));
    add("position", 3, (box, corner) => corner.position);
    add("normal", 3, (box, corner) => corner.normal);
    add("uv", 2, (box, corner) => corner.uv);
    add("centre", 3, (box) => box.centre);
    add("size", 3, (box) => box.size);
    add("turn", 2, (box) => [box.cos, box.sin]);
    boxes.forEach((box, k) => Object.assign(box, {
      first: k * FACES.length,
      tint: plain(box.noFly ? this.colours.noFly : shades[box.number % shades.length]).toArray(),
    }));
    add("tint", 3, (box) => box.tint);
    add("picked", 1, () => 0);
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(18 * boxes.length), 1));
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    boxes.forEach((box) => { box.mesh = mesh; });
    mesh.userData.boxes = boxes;
    this.three.add(mesh);
    return mesh;
  }

  /** Draws near boxes before far ones, so that what they hide costs nothing. */
  sortBoxes(camera) {
    const { x, y, z } = camera.position;
    if (this.sortedFrom !== undefined && camera.position.distanceTo(this.sortedFrom) < .02 * this.diagonal) return;
    this.sortedFrom = camera.position.clone();
    for (const mesh of [this.solid, this.zones]) {
      if (mesh === null) continue;
      const { boxes } = mesh.userData, { index } = mesh.geometry;
      for (const box of boxes)
        box.away = Math.hypot(box.centre[0] - x, box.centre[1] - y, box.centre[2] - z);
      boxes.sort((one, two) => one.away - two.away);
      let at = 0;
      for (const { first } of boxes)
        for (let corner = first; corner < first + 12; corner += 4)
          for (const k of [0, 1, 2, 0, 2, 3]) index.array[at++] = corner + k;
      index.needsUpdate = true;
    }
  }

  /** Marks a box, or no longer. */
  pick(box, on) {
    const { picked } = box.mesh.geometry.attributes;
    picked.array.fill(on ? 1 : 0, box.first, box.first + FACES.length);
    picked.needsUpdate = true;
  }

  addBounds() {
    const corner = (k) => [0, 1, 2].map((axis) => this.scene.bounds[(k >> axis) & 1][axis]);
    const ends = [];
    for (let k = 0; k < 8; k++)
      for (let axis = 0; axis < 3; axis++)
        if (!((k >> axis) & 1)) ends.push(...corner(k), ...corner(k | (1 << axis)));
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(ends), 3));
    this.bound = new THREE.LineBasicMaterial({ transparent: true, opacity: .55 });
    this.three.add(new THREE.LineSegments(geometry, this.bound));
  }

  addDepot(at, node) {
    const radius = this.scene.returnTolerance;
    const mesh = new THREE.Mesh(
      new THREE.CylinderGeometry(1, 1, .12, 40).rotateX(Math.PI / 2),
      new THREE.MeshLambertMaterial({ color: this.colours.depot, transparent: true, opacity: .85 }),
    );
    return this.addNode(mesh, at, node, radius);
  }

  addItem(at, node) {
    const mesh = new THREE.Mesh(
      new THREE.SphereGeometry(1, 24, 16),
      new THREE.MeshLambertMaterial({ color: this.colours.item, transparent: true }),
    );
    return this.addNode(mesh, at, node, this.scene.epsilon);
  }

  addNode(mesh, at, node, radius) {
    mesh.position.set(...at);
    mesh.userData.node = node;
    this.three.add(mesh);
    return { mesh, node, radius, at: mesh.position };
  }

  /** Makes nodes large enough to be seen from the camera, and colours them by `looks`. */
  showNodes(camera, pixel, looks) {
    for (const node of this.nodes) {
      const look = looks(node.node), away = camera.position.distanceTo(node.at);
      const least = (node.node < 0 ? 7 : 6) * pixel * away;
      node.mesh.scale.setScalar(Math.max(node.radius, least) * look.grow);
      node.mesh.material.color.set(look.colour);
      node.mesh.material.opacity = look.opacity;
      node.mesh.material.depthWrite = look.opacity === 1;
      node.look = look;
    }
  }

  setTheme(name) {
    const theme = THEMES[name];
    this.three.background = new THREE.Color(theme.sky);
    this.ground.uniforms.sky.value.copy(plain(theme.sky));
    this.ground.uniforms.ground.value.copy(plain(theme.ground));
    this.ground.uniforms.line.value.copy(plain(theme.line));
    this.bound.color.set(theme.bound);
    for (const mesh of [this.solid, this.zones]) {
      if (mesh === null) continue;
      mesh.material.uniforms.edge.value.copy(plain(this.glass ? theme.bound : theme.edge));
      mesh.material.uniforms.shade.value = theme.shade;
    }
  }

  setGlass(on, theme) {
    this.glass = on;
    this.setTheme(theme);
    if (this.solid === null) return;
    this.solid.material.transparent = on;
    this.solid.material.depthWrite = !on;
    this.solid.material.uniforms.opacity.value = on ? .16 : 1;
    this.solid.material.needsUpdate = true;
  }

  /** Returns the first box within a margin of a ray of unit direction, and how far it is (m).
   *
   * A ray does not meet boxes that it begins in. No-fly zones only count if `zones` is set.
   */
  firstBox(from, direction, margin, most, zones) {
    let least = most, first = null;
    for (const box of this.boxes) {
      if (box.noFly && !zones) continue;
      const dx = from.x - box.centre[0], dy = from.y - box.centre[1];
      const at = [box.cos * dx + box.sin * dy, box.cos * dy - box.sin * dx, from.z - box.centre[2]];
      const along = [
        box.cos * direction.x + box.sin * direction.y,
        box.cos * direction.y - box.sin * direction.x, direction.z,
      ];
      let enter = -Infinity, leave = Infinity;
      for (let axis = 0; axis < 3 && enter <= leave; axis++) {
        const half = box.size[axis] / 2 + margin, slope = along[axis] || 1e-12;
        const one = (-half - at[axis]) / slope, two = (half - at[axis]) / slope;
        enter = Math.max(enter, Math.min(one, two));
        leave = Math.min(leave, Math.max(one, two));
      }
      if (enter <= leave && enter >= 0 && enter < least) { least = enter; first = box; }
    }
    return { box: first, distance: least };
  }

  /** Returns how far (m) a ray goes before it is within a margin of a solid box, at most `most`. */
  clearance(from, direction, margin, most) {
    return this.firstBox(from, direction, margin, most, false).distance;
  }
}
