// Puts it all together: state, frames, keys.

const SLOW = 36; // Frames that take longer (ms) are drawn with fewer pixels while playing.
const LEAST = .5; // Never fewer than this share of the window's along each side.
const OFTEN = 90; // While it plays, numbers change after so long (ms).
const CALM = 250; // What has not changed for so long (ms) is drawn once more, smoothly.

const replay = JSON.parse(find("data").textContent);
const canvas = find("view");

function start() {
  const renderer = openRenderer();
  if (renderer === null) return;
  const three = new THREE.Scene(), { colours } = replay;
  const world = new World(replay.scene, colours, three);
  const flights = replay.runs.flatMap((run) => run.flights.map((part) => [part, run]));
  const uavs = flights.map(([part, run], k) => new Uav(new Flight(part, run), world, colours.speed));
  const fleets = replay.runs.some((run) => run.flights[0].name !== null);
  uavs.forEach((uav, k) => {
    uav.index = k;
    uav.run = replay.runs.indexOf(uav.flight.run);
    const { name, run } = uav.flight;
    uav.label = replay.runs.length === 1 ? name ?? "UAV" : fleets && name !== null ? `${run.name}: ${name}` : run.name;
  });
  const movers = replay.runs.flatMap((run) => run.moving.map((box, k) => {
    const whose = replay.runs.length > 1 ? ` of ${run.name}` : "";
    return new Mover(box, `moving box ${k}${whose}`, colours.moving, world);
  }));
  const duration = Math.max(...uavs.map((uav) => uav.flight.duration));
  const state = {
    t: 0, playing: false, camera: "orbit", followed: 0, bySpeed: uavs.length === 1, glass: false,
    names: true, theme: matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light",
    rate: RATES.find((rate) => rate >= 1 && duration / rate <= LONGEST) ?? RATES.at(-1),
  };
  let awake = true, jump = true, last = null, frames = 0, touched = false, share = 1, pace = null;
  let calm = 0; // ms since anything changed
  let told = 0; // when numbers were last shown (ms)
  const wake = () => { awake = true; };

  const cameras = new Cameras(world, canvas, wake);
  const hover = new Hover(world, uavs, movers, canvas, find("tip"));
  const labels = new Labels(find("labels"), world, uavs);
  const panel = new Panel(replay, uavs, colours, (k) => act.follow(k));
  for (const camera of [cameras.orbit, cameras.top])
    camera.controls.addEventListener("start", () => { touched = true; });

  const act = {
    seek(t) { state.t = Math.min(Math.max(t, 0), duration); jump = true; wake(); },
    toggle() {
      if (!state.playing && state.t >= duration) act.seek(0);
      state.playing = !state.playing;
      last = pace = null;
      if (!state.playing) resize(1);
      wake();
    },
    rate(rate) { state.rate = rate; wake(); },
    faster(step) {
      const at = RATES.indexOf(state.rate) + step;
      act.rate(RATES[Math.min(Math.max(at, 0), RATES.length - 1)]);
    },
    stop(step) {
      const times = [0, ...uavs.flatMap(({ flight }) => flight.stops.map((stop) => stop.t))];
      const sorted = times.filter((t) => t !== null).sort((one, two) => one - two);
      const found = step > 0 ? sorted.find((t) => t > state.t + .01) : sorted.findLast((t) => t < state.t - .01);
      act.seek(found ?? (step > 0 ? duration : 0));
    },
    camera(name) { state.camera = name; cameras.use(name); jump = true; buttons(); },
    follow(k) { state.followed = k % uavs.length; jump = true; wake(); },
    colouring() {
      state.bySpeed = !state.bySpeed;
      uavs.forEach((uav) => uav.track.colour(state.bySpeed));
      panel.legend(state.bySpeed);
      buttons();
    },
    glass() { state.glass = !state.glass; world.setGlass(state.glass, state.theme); buttons(); },
    names() { state.names = !state.names; find("labels").hidden = !state.names; buttons(); },
    theme() { state.theme = state.theme === "dark" ? "light" : "dark"; applyTheme(); buttons(); },
    keys() { find("help").hidden = !find("help").hidden; buttons(); },
  };
  const transport = new Transport(replay, uavs, duration, act);

  function applyTheme() {
    document.documentElement.dataset.theme = state.theme;
    world.setTheme(state.theme);
  }

  function buttons() {
    for (const button of document.querySelectorAll("[data-camera]"))
      button.classList.toggle("on", button.dataset.camera === state.camera);
    setText(find("colouring"), state.bySpeed ? "By speed" : uavs.length > 1 ? "By UAV" : "Plain");
    setText(find("theme"), state.theme === "dark" ? "Light" : "Dark");
    find("glass").setAttribute("aria-pressed", state.glass);
    find("names").setAttribute("aria-pressed", state.names);
    find("keys").setAttribute("aria-expanded", !find("help").hidden);
    wake();
  }

  function resize(to) {
    share = to;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * share);
    renderer.setSize(innerWidth, innerHeight, false);
    cameras.resize(innerWidth, innerHeight, !touched);
    wake();
  }

  /** Returns colour, opacity and size of a node. */
  function look(node) {
    if (node < 0) return { colour: colours.depot, opacity: .85, grow: 1 };
    const several = uavs.length > 1;
    for (const { flight } of uavs) {
      const end = Math.min(state.t, flight.duration);
      if (flight.collectedAt(node) <= state.t + 1e-6)
        return { colour: several ? flight.colour : colours.collected, opacity: .5, grow: 1 };
      if (!several && flight.stops[flight.reached(end)]?.node === node)
        return { colour: colours.target, opacity: 1, grow: 1.15 };
    }
    return { colour: several ? "#eceff2" : colours.item, opacity: 1, grow: 1 };
  }

  function describe(found, t) {
    if (found.uav) {
      const { state: at } = found.uav, place = at.x.map((c) => c.toFixed(1)).join(", ");
      return [found.uav.label, `at ${place} m · ${at.speed.toFixed(1)} m/s`];
    }
    if (found.mover) return [found.mover, "moves to and fro"];
    if (found.box) {
      const { number, size, yaw, noFly } = found.box;
      const turned = yaw ? `, turned by ${yaw.toFixed(0)}°` : "";
      const digits = Math.max(...size) < 10 ? 2 : Math.max(...size) < 100 ? 1 : 0;
      const sides = size.map((side) => side.toFixed(digits)).join(" × ");
      return [`${noFly ? "no-fly zone" : "box"} ${number}`, `${sides} m${turned}`];
    }
    const by = uavs.flatMap(({ flight, label }) => {
      const when = found.node < 0 ? Infinity : flight.collectedAt(found.node);
      if (when === Infinity) return [];
      const whose = uavs.length > 1 ? ` by ${label}` : "";
      return [when < 0 ? "collected before" : `${when <= t ? "collected" : "to be collected"} at ${seconds(when)}${whose}`];
    });
    return [nodeName(found.node), by.join(", ")];
  }

  function draw(dt) {
    for (const uav of uavs) uav.place(state.t);
    for (const mover of movers) mover.place(state.t);
    const followed = uavs[state.followed];
    if (state.camera === "chase") cameras.follow(followed, dt, jump);
    jump = false;
    cameras.setPlanes();
    const camera = cameras.active;
    const pixel = 2 * Math.tan(camera.fov * Math.PI / 360) / innerHeight;
    world.sortBoxes(camera);
    world.showNodes(camera, pixel, look);
    for (const uav of uavs) uav.fit(camera, pixel, state.camera === "chase" && uav === followed);
    hover.show(camera, state.t, describe);
    renderer.render(three, camera);
    if (state.names) labels.show(camera, innerWidth, innerHeight, state.camera === "chase" ? followed : null);
    if (!state.playing || performance.now() - told > OFTEN) {
      told = performance.now();
      panel.show(state.t, followed);
      transport.show(state.t, state.playing, state.rate);
    }
    frames++;
  }

  /** Draws with fewer pixels where frames take long, as on a computer without a graphics card. */
  function keepPace(took) {
    pace = pace === null ? { mean: took, count: 0 } : { mean: .85 * pace.mean + .15 * took, count: pace.count + 1 };
    if (pace.count > 12 && pace.mean > SLOW && share > LEAST) {
      resize(Math.max(share * .75, LEAST));
      pace = null;
    }
  }

  function frame(now) {
    const took = last === null ? 0 : now - last;
    if (state.playing) {
      if (last !== null) keepPace(took);
      state.t = Math.min(state.t + Math.min(took, 500) / 1000 * state.rate, duration);
      if (state.t >= duration) { state.playing = false; resize(1); }
      awake = true;
    }
    last = now;
    if (hover.moved && !awake && hover.show(cameras.active, state.t, describe)) awake = true;
    calm = awake ? 0 : calm + took;
    if (awake && share > 1) resize(1);
    // A processor draws without smooth edges; four pixels for one smooth them when it has time.
    if (calm > CALM && share === 1 && renderer.software) {
      resize(2);
      calm = 0;
    }
    if (awake) {
      awake = false;
      draw(Math.min(took, 500) / 1000);
    }
    requestAnimationFrame(frame);
  }

  const keys = {
    " ": act.toggle, ArrowUp: () => act.faster(1), ArrowDown: () => act.faster(-1),
    Home: () => act.seek(0), End: () => act.seek(duration), "[": () => act.stop(-1), "]": () => act.stop(1),
    1: () => act.camera("orbit"), 2: () => act.camera("chase"), 3: () => act.camera("top"),
    n: () => act.follow(state.followed + 1), c: act.colouring, x: act.glass, l: act.names, t: act.theme,
    "?": act.keys, Escape: () => { if (!find("help").hidden) act.keys(); },
  };
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    if (event.key === " " && event.target.tagName === "BUTTON") return; // It presses the button.
    const arrow = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const action = arrow ? () => act.seek(state.t + arrow * (event.shiftKey ? 5 : 1))
      : keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });
  // A button that was clicked would take the space key as another click.
  document.addEventListener("click", (event) => event.target.closest("button")?.blur());
  for (const button of document.querySelectorAll("[data-camera]"))
    button.addEventListener("click", () => act.camera(button.dataset.camera));
  for (const id of ["colouring", "glass", "names", "theme", "keys"]) find(id).addEventListener("click", act[id]);
  find("next").hidden = uavs.length === 1;
  find("next").addEventListener("click", () => act.follow(state.followed + 1));
  window.addEventListener("resize", () => resize(share));

  uavs.forEach((uav) => uav.track.colour(state.bySpeed));
  panel.legend(state.bySpeed);
  applyTheme();
  resize(1);
  act.camera("orbit");
  requestAnimationFrame(frame);
  // What tests and measurements ask for.
  window.replay = {
    act, look, state: () => ({ ...state, duration, frames, share }),
    uavs: () => uavs.map((uav) => ({ label: uav.label, x: [...uav.state.x], speed: uav.state.speed, screen: onScreen(uav.model.position) })),
    box: (k) => onScreen(new THREE.Vector3(...world.boxes[k].centre)),
  };

  /** Returns the pixel of a point (x, y), from the window's upper left corner. */
  function onScreen(point) {
    const at = point.clone().project(cameras.active);
    return [(at.x + 1) / 2 * innerWidth, (1 - at.y) / 2 * innerHeight];
  }
}

/** Returns the renderer, or null after saying that there is no WebGL. */
function openRenderer() {
  try {
    const software = isSoftware();
    const context = canvas.getContext("webgl2", { antialias: !software, alpha: false });
    if (context === null) throw new Error("no WebGL 2");
    return Object.assign(new THREE.WebGLRenderer({ canvas, context }), { software });
  } catch (error) {
    const message = find("message");
    message.textContent = "This browser shows no 3D graphics (WebGL 2) here. Turn on graphics acceleration in its " +
      `settings, or open this file in another browser. (${error.message})`;
    message.hidden = false;
    return null;
  }
}

/** Returns whether a processor draws: smooth edges would take it too long. */
function isSoftware() {
  const probe = document.createElement("canvas").getContext("webgl2");
  const names = probe?.getExtension("WEBGL_debug_renderer_info");
  const name = names ? probe.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  probe?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

start();
