// What stands: ground, boxes, bounds, depots, items.

const THEMES = {
  light: { sky: 0xdfe7ef, ground: 0xc3ccc8, line: 0xb0bab7, edge: 0x5a6672, bound: 0x8a97a5, shade: 1 },
  dark: { sky: 0x141b24, ground: 0x222c36, line: 0x303c48, edge: 0x0c1117, bound: 0x5c6a78, shade: .62 },
};

// Boxes are shaded by where their faces look; edges are as thin as pixels allow.
const BOX_VERTEX = `
  attribute float picked;
  varying vec3 vPlace; varying vec3 vNormal; varying vec3 vColour; varying float vPicked;
  void main() {
    vPlace = position; vNormal = normal; vPicked = picked;
    vec3 turned = normalize(mat3(instanceMatrix) * normal);
    float sun = dot(turned, normalize(vec3(-.4, -.3, .85)));
    float shade = .70 + .24 * max(sun, 0.) + .10 * turned.z + .07 * turned.x;
    vColour = instanceColor * shade;
    gl_Position = projectionMatrix * viewMatrix * instanceMatrix * vec4(position, 1.);
  }`;
const BOX_FRAGMENT = `
  uniform vec3 edge; uniform float shade; uniform float opacity;
  varying vec3 vPlace; varying vec3 vNormal; varying vec3 vColour; varying float vPicked;
  void main() {
    vec3 pixel = fwidth(vPlace) + abs(vNormal);
    vec3 away = (.5 - abs(vPlace)) / pixel + step(.5, abs(vNormal)) * 1e6;
    float line = 1. - smoothstep(.4, 1.4, min(away.x, min(away.y, away.z)));
    vec3 wide = mix(1. / pixel, vec3(1e6), step(.5, abs(vNormal)));
    line *= smoothstep(4., 22., min(wide.x, min(wide.y, wide.z)));  // none on boxes of a few pixels
    vec3 colour = vColour * shade * mix(.80, 1., smoothstep(-.5, .35, vPlace.z));
    colour = mix(colour, edge, line * .62);
    colour = mix(colour, vec3(1., .78, .25), vPicked * .55);
    gl_FragColor = vec4(colour, mix(opacity, min(1., opacity + .5), max(line, vPicked)));
    #include <colorspace_fragment>
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
    #include <colorspace_fragment>
  }`;

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
      transparent: opacity < 1, depthWrite: opacity === 1,
      uniforms: {
        edge: { value: new THREE.Color() }, shade: { value: 1 }, opacity: { value: opacity },
      },
    });
    const geometry = new THREE.BoxGeometry(1, 1, 1);
    const mesh = new THREE.InstancedMesh(geometry, material, boxes.length);
    const matrix = new THREE.Matrix4(), colour = new THREE.Color();
    boxes.forEach((box, k) => {
      matrix.makeRotationZ(box.yaw * Math.PI / 180);
      matrix.scale(new THREE.Vector3(...box.size));
      matrix.setPosition(...box.centre);
      mesh.setMatrixAt(k, matrix);
      const shades = this.colours.boxes;
      mesh.setColorAt(k, colour.set(box.noFly ? this.colours.noFly : shades[box.number % shades.length]));
    });
    geometry.setAttribute(
      "picked", new THREE.InstancedBufferAttribute(new Float32Array(boxes.length), 1));
    mesh.userData.boxes = boxes;
    mesh.computeBoundingSphere();
    this.three.add(mesh);
    return mesh;
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
    return { mesh, node, radius, at: mesh.position, rings: [] };
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
    this.ground.uniforms.sky.value.set(theme.sky);
    this.ground.uniforms.ground.value.set(theme.ground);
    this.ground.uniforms.line.value.set(theme.line);
    this.bound.color.set(theme.bound);
    for (const mesh of [this.solid, this.zones]) {
      if (mesh === null) continue;
      mesh.material.uniforms.edge.value.set(theme.edge);
      mesh.material.uniforms.shade.value = theme.shade;
    }
  }

  setGlass(on) {
    if (this.solid === null) return;
    this.solid.material.transparent = on;
    this.solid.material.depthWrite = !on;
    this.solid.material.uniforms.opacity.value = on ? .16 : 1;
    this.solid.material.needsUpdate = true;
  }

  /** Returns how far (m) a ray of unit direction goes before it is within a margin of a box. */
  clearance(from, direction, margin, most) {
    let least = most;
    for (const box of this.boxes) {
      if (box.noFly) continue;
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
      if (enter <= leave && enter >= 0 && enter < least) least = enter;
    }
    return least;
  }
}
