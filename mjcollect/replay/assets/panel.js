// The plates: flights with their read-outs, legend, playback.

const RATES = [.1, .25, .5, 1, 2, 4, 8, 16];
const LONGEST = 60; // A longer flight is played faster at first, to last about so long (s).

function make(kind, name, text) {
  const element = document.createElement(kind);
  if (name) element.className = name;
  if (text !== undefined) element.textContent = text;
  return element;
}

const seconds = (t) => `${t.toFixed(1)} s`;
const find = (id) => document.getElementById(id);

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function verdict(run, best) {
  if (!run.success) return run.caption ?? "not finished";
  const late = best !== null && run.duration > best + .05 ? ` (+${(run.duration - best).toFixed(1)})` : "";
  return seconds(run.duration) + late;
}

/** The plate of runs and flights. */
class Panel {
  constructor(replay, uavs, colours, follow) {
    this.uavs = uavs;
    this.several = replay.runs.length > 1;
    const { scene, runs } = replay;
    setText(find("scene-name"), runs.length === 1 ? runs[0].name : scene.name);
    setText(find("subtitle"), runs.length === 1 ? this.subtitle(scene, runs[0]) : `${runs.length} runs compared`);
    const times = runs.filter((run) => run.success).map((run) => run.duration);
    // Only runs to the same places can be faster or slower than each other.
    const places = new Set(runs.map((run) => JSON.stringify([run.kind, run.flights.flatMap((flight) =>
      flight.stops.map((stop) => stop.node)).sort()])));
    const best = this.several && times.length > 0 && places.size === 1 ? Math.min(...times) : null;
    for (const run of runs) {
      const own = uavs.filter((uav) => uav.flight.run === run);
      const single = own.length === 1 && own[0].flight.name === null;
      if (runs.length > 1 && !single) find("rows").append(this.head(run, best));
      for (const uav of own) find("rows").append(this.row(uav, run, single ? best : undefined, follow));
    }
    this.colours = colours;
    this.scene = scene;
  }

  subtitle(scene, run) {
    const parts = [scene.name, run.kind, run.planner].filter(Boolean);
    if (run.success && run.lowerBound > 0)
      parts.push(`${(run.duration / run.lowerBound).toFixed(3)} of the lower bound`);
    if (run.wind !== null) parts.push(`wind ${Math.hypot(...run.wind).toFixed(1)} m/s²`);
    return parts.join(" · ");
  }

  head(run, best) {
    const element = make("div", "run"), chip = make("i", "chip");
    chip.style.background = run.colour;
    element.append(chip, make("span", "", run.name), this.result(run, best));
    return element;
  }

  result(run, best) {
    return make("span", run.success ? "result" : "result failed", verdict(run, best));
  }

  row(uav, run, best, follow) {
    const { flight } = uav, row = make("button", "row"), chip = make("i", "chip");
    row.type = "button";
    row.title = "Follow";
    chip.style.background = flight.colour;
    const several = best === undefined;
    const arrived = flight.stops.at(-1)?.t;
    const result = several
      ? make("span", "result", arrived === null ? "not home" : seconds(arrived)) : this.result(run, best);
    const read = make("span", "read"), goal = make("span", "goal");
    const speed = make("b"), length = make("b"), shield = make("span", "shield", "shield");
    const speeds = make("span", "speed"), lengths = make("span");
    speeds.append(speed, " m/s");
    lengths.append(length, " m");
    read.append(speeds, lengths, shield);
    row.append(chip, make("span", "name", flight.name ?? (this.several ? run.name : "UAV")), result, read, goal);
    row.addEventListener("click", () => follow(uav.index));
    uav.row = { row, speed, length, goal, shield };
    return row;
  }

  /** Shows the read-outs at a time; `followed` is the UAV that is followed. */
  show(t, followed) {
    for (const uav of this.uavs) {
      const { flight, state, row } = uav, end = Math.min(t, flight.duration);
      setText(row.speed, state.speed.toFixed(state.speed < 9.95 ? 1 : 0));
      setText(row.length, state.length.toFixed(flight.length < 100 ? 1 : 0));
      row.shield.hidden = !flight.shielded(end);
      row.row.classList.toggle("followed", this.uavs.length > 1 && uav === followed);
      const reached = flight.reached(end);
      const over = t >= flight.duration && flight.duration > 0;
      const items = flight.stops.slice(0, reached).filter((stop) => stop.node >= 0).length;
      const all = flight.stops.filter((stop) => stop.node >= 0).length;
      const next = reached < flight.stops.length ? nodeName(flight.stops[reached].node) : null;
      const collected = all > 0 ? `${items} of ${all} item${all > 1 ? "s" : ""}` : "";
      const doing = next === null ? "arrived" : over ? `ended before ${next}` : `to ${next}`;
      setText(row.goal, [collected, doing].filter(Boolean).join(" · "));
    }
  }

  legend(bySpeed) {
    const legend = find("legend"), { colours, scene } = this;
    legend.replaceChildren();
    if (bySpeed) {
      const bar = make("div", "bar"), ends = make("div", "ends");
      bar.style.background = `linear-gradient(to right, ${colours.speed.join(", ")})`;
      ends.append(make("span", "", "0"), make("span", "", "speed"), make("span", "", `${scene.vMax} m/s`));
      legend.append(bar, ends);
    }
    const kinds = make("div", "kinds"), several = this.uavs.length > 1;
    const entries = [
      ["item", several ? "#eceff2" : colours.item],
      ...(several ? [] : [["next", colours.target], ["collected", colours.collected]]),
      ["depot", colours.depot],
    ];
    if (this.uavs.some((uav) => uav.flight.run.moving.length > 0)) entries.push(["moving", colours.moving, "square"]);
    if (scene.noFly.length > 0) entries.push(["no-fly", colours.noFly, "square"]);
    for (const [text, colour, shape] of entries) {
      const dot = make("i", shape), entry = make("span");
      dot.style.background = colour;
      entry.append(dot, text);
      kinds.append(entry);
    }
    legend.append(kinds);
  }
}

/** The bar with play, time and speed. */
class Transport {
  constructor(replay, uavs, duration, actions) {
    this.duration = duration;
    this.scrub = find("scrub");
    this.scrub.max = duration;
    this.scrub.addEventListener("input", () => actions.seek(Number(this.scrub.value)));
    find("play").addEventListener("click", actions.toggle);
    const rates = find("rate");
    for (const rate of RATES) rates.append(new Option(`${rate}×`, rate));
    rates.addEventListener("change", () => { actions.rate(Number(rates.value)); rates.blur(); });
    this.addMarks(replay, uavs);
  }

  addMarks(replay, uavs) {
    const lanes = replay.runs.length > 1 ? replay.runs.length : 1;
    const add = (t, colour, top, height, title) => {
      const mark = make("i");
      mark.title = title;
      Object.assign(mark.style, {
        left: `${100 * t / Math.max(this.duration, 1e-9)}%`, background: colour, top: `${top}px`, height: `${height}px`,
      });
      find("marks").append(mark);
    };
    for (const { flight } of uavs) {
      const lane = lanes > 1 ? replay.runs.indexOf(flight.run) : 0;
      const colour = lanes > 1 || flight.name !== null ? flight.colour : null;
      for (const stop of flight.stops) {
        if (stop.t === null) continue;
        const own = stop.node < 0 ? replay.colours.depot : replay.colours.collected;
        // One run has marks above the bar; a second one has its own below it.
        const top = lanes > 1 && lane % 2 === 1 ? 25 : 2;
        add(stop.t, colour ?? own, top, 9, `${nodeName(stop.node)} at ${seconds(stop.t)}`);
      }
    }
    for (const run of replay.runs) for (const each of run.violations) add(each.t, "#d5402e", 0, 36, each.text);
  }

  show(t, playing, rate) {
    this.scrub.value = t;
    this.scrub.style.setProperty("--gone", `${100 * t / Math.max(this.duration, 1e-9)}%`);
    this.scrub.setAttribute("aria-valuetext", seconds(t));
    const clock = find("clock"), whole = make("span", "", ` / ${seconds(this.duration)}`);
    clock.replaceChildren(t.toFixed(1), whole);
    find("play-shape").setAttribute("d", playing ? "M6 4.5h4.5v15H6zM13.5 4.5H18v15h-4.5z" : "M7 4.5v15l12.5-7.5z");
    find("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    find("rate").value = rate;
  }
}
