// The page: pointer, keyboard, sliders and readings.

import { EnergyPlot, Panel, TOP_SPEED, colorsOf } from "./view.mjs";
import { World } from "./world.mjs";

const BUDGET = 14; // time for steps between two pictures [ms]
const CURSOR_STEP = 0.02; // of an arrow key [m], in a domain of 1 m
const READINGS_EVERY = 200; // [ms]

const $ = (id) => document.getElementById(id);

/** Return numbers from base64 of their bytes. */
function decoded(text, Kind) {
  const bytes = atob(text);
  return new Kind(Uint8Array.from(bytes, (letter) => letter.charCodeAt(0)).buffer);
}

/** Return a number with three digits. */
const short = (value) => (Math.abs(value) >= 100 || value === 0 ? value.toFixed(0) : value.toPrecision(3));

class Page {
  constructor(models) {
    this.models = models;
    this.cursor = null;
    this.playing = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.behind = 0;
    this.counts = { steps: 0, since: performance.now(), cost: 0 };
    this.plot = new EnergyPlot($("energy"));
    $("model").replaceChildren(...models.map((model, k) => new Option(model.name, k)));
    $("model-row").hidden = models.length < 2;
    this.open(0);
    this.listen();
    this.before = performance.now();
    requestAnimationFrame((now) => this.frame(now));
  }

  // --- scenes ----------------------------------------------------------------------------------------------------------------------------------

  open(number) {
    const model = this.models[number];
    this.model = model;
    this.world = new World(model, decoded(model.weights, Float32Array));
    this.panel = new Panel($("stage"), model.bounds);
    this.film = new Panel($("film"), model.bounds);
    $("scene").replaceChildren(new Option("block and obstacle", ""), ...model.scenes.map((scene, k) => new Option(scene.name, k)));
    $("scene-row").hidden = !model.scenes.length;
    $("material").textContent = model.material;
    $("parameters").replaceChildren(...model.parameters.map((parameter, k) => this.slider(parameter, k)));
    $("speed-range").textContent = `speed, 0 to ${short(TOP_SPEED * this.world.pace)} m/s`;
    this.showSide();
    $("ranges").replaceChildren(...Object.entries(model.trained).map(([name, range]) => {
      const item = document.createElement("li");
      item.textContent = `${name}: ${range}`;
      return item;
    }));
    $("scene").value = model.scenes.length ? "0" : "";
    this.restart();
  }

  restart() {
    const choice = $("scene").value;
    this.choice = choice === "" ? null : this.model.scenes[Number(choice)];
    this.world.reset(this.choice);
    this.world.parameters.forEach((value, k) => this.showParameter(k, value));
    if (this.choice && !this.choice.frames) this.choice.frames = decoded(this.choice.film, Uint16Array);
    $("film-side").hidden = !this.choice;
    this.plot.clear();
    this.cursor = null;
    this.behind = 0;
    this.say("");
  }

  slider(parameter, k) {
    const row = document.createElement("label"), input = document.createElement("input"), value = document.createElement("output");
    const isLog = parameter.isLog, at = isLog ? Math.log : (v) => v;
    Object.assign(input, { type: "range", min: 0, max: 100, step: 1, id: `parameter-${k}` });
    Object.assign(value, { id: `value-${k}` });
    input.addEventListener("input", () => {
      const place = at(parameter.low) + (input.value / 100) * (at(parameter.high) - at(parameter.low));
      const values = [...this.world.parameters];
      values[k] = isLog ? Math.exp(place) : place;
      this.world.setParameters(values);
      this.world.untouched = false;
      this.showParameter(k, values[k]);
    });
    row.append(`${parameter.name.replaceAll("_", " ")} `, value, input);
    return row;
  }

  showParameter(k, value) {
    const { low, high, isLog, unit } = this.model.parameters[k], at = isLog ? Math.log : (v) => v;
    const text = `${value.toPrecision(3)}${unit === "1" ? "" : ` ${unit === "deg" ? "°" : unit}`}`;
    $(`parameter-${k}`).value = high > low ? (100 * (at(value) - at(low))) / (at(high) - at(low)) : 0;
    $(`parameter-${k}`).setAttribute("aria-valuetext", text);
    $(`value-${k}`).textContent = text;
  }

  /** The side of new blocks [m]; the slider has fractions of the domain. */
  get side() {
    return Number($("size").value) * this.world.unit;
  }

  showSide() {
    $("side").textContent = `${short(this.side)} m`;
  }

  // --- time ------------------------------------------------------------------------------------------------------------------------------------

  frame(now) {
    const { world, counts } = this, dt = this.model.frameDt, passed = Math.min((now - this.before) / 1000, 0.1);
    this.before = now;
    if (this.playing) {
      this.behind += passed * Number($("speed").value);
      const start = performance.now();
      while (this.behind >= dt && performance.now() - start < BUDGET) {
        this.behind -= dt;
        this.step();
      }
      this.behind = Math.min(this.behind, 2 * dt); // what the computer cannot do in time is left out
    }
    this.draw();
    if (now - counts.since > READINGS_EVERY) this.readings(now);
    requestAnimationFrame((next) => this.frame(next));
  }

  step() {
    const start = performance.now();
    if (!this.world.step()) {
      this.play(false);
      this.say(`${this.world.problem} Restart (R) starts again.`);
      return;
    }
    this.counts.cost += performance.now() - start;
    this.counts.steps++;
    if (Math.round(this.world.time / this.model.frameDt) % 4 === 0) this.plot.add(this.world.energies());
  }

  draw() {
    const { world, model, choice } = this, { state } = world;
    this.panel.draw({
      shapes: world.shapes, pos: state.pos, count: state.count, spacing: model.spacing, colorOf: colorsOf($("color").value, world), cursor: this.cursor,
    });
    this.plot.draw();
    if (!choice) return;
    const frame = Math.min(Math.round(world.time / model.frameDt), choice.numFrames - 1), pos = new Float64Array(2 * choice.count);
    const [[left, right], [bottom, top]] = model.bounds;
    for (let n = 0; n < choice.count; n++) {
      pos[2 * n] = left + (choice.frames[2 * (frame * choice.count + n)] / 65535) * (right - left);
      pos[2 * n + 1] = bottom + (choice.frames[2 * (frame * choice.count + n) + 1] / 65535) * (top - bottom);
    }
    this.film.draw({ shapes: choice.shapes, pos, count: choice.count, spacing: model.spacing, colorOf: () => "#1f77b4" });
    $("film-note").textContent = world.untouched
      ? frame === choice.numFrames - 1 ? "the film has ended" : ""
      : "the film shows the scene as it was at the start; Restart (R) compares again";
  }

  readings(now) {
    const { counts, world } = this, seconds = (now - counts.since) / 1000, { kinetic, potential, fastest } = world.energies();
    const rate = counts.steps / seconds;
    $("time").textContent = `${world.time.toFixed(2)} s`;
    $("rate").textContent = this.playing ? `${rate.toFixed(0)} /s (${(rate * this.model.frameDt).toFixed(2)} × real time)` : "paused";
    $("cost").textContent = counts.steps ? `${(counts.cost / counts.steps).toFixed(1)} ms` : "–";
    $("nodes").textContent = `${world.state.count} particles, ${world.last.edges} edges`;
    $("kinetic").textContent = `${short(kinetic)} J`;
    $("potential").textContent = `${short(potential)} J`;
    $("fastest").textContent = `${short(fastest)} m/s`;
    this.counts = { steps: 0, since: now, cost: 0 };
  }

  play(on) {
    this.playing = on;
    $("play").textContent = on ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", String(on));
  }

  say(text) {
    $("status").textContent = text;
  }

  // --- actions ---------------------------------------------------------------------------------------------------------------------------------

  grab(x, y) {
    const what = this.world.grab(x, y);
    if (what === "obstacle") this.say("Holding an obstacle. Obstacles did not move in training.");
    if (what === "block") this.say("Holding a block. Let go while moving to throw it.");
    return what;
  }

  release() {
    if (!this.world.hand) return;
    const speed = this.world.release();
    this.say(speed ? `Thrown at ${short(speed)} m/s.` : "Released.");
  }

  addBlock([x, y]) {
    const count = this.world.addBlock(x, y, this.side);
    this.say(count ? `Added a block of ${count} particles.` : "No room for a block there.");
  }

  addObstacle([x, y]) {
    this.world.addObstacle(x, y);
    this.say("Added an obstacle.");
  }

  /** A point for what a button adds: the keyboard's cursor, or one in the upper half. */
  get place() {
    const [[left, right], [bottom, top]] = this.model.bounds, turn = (this.world.numBlocks * 0.37) % 0.6;
    return this.cursor || [left + (0.2 + turn) * (right - left), bottom + 0.8 * (top - bottom)];
  }

  listen() {
    const stage = $("stage"), buttons = {
      play: () => this.play(!this.playing),
      step: () => {
        this.play(false);
        this.step();
      },
      reset: () => {
        this.restart();
        this.say("Started again.");
      },
      block: () => this.addBlock(this.place),
      obstacle: () => this.addObstacle(this.place),
    };
    for (const [id, action] of Object.entries(buttons)) $(id).addEventListener("click", action);
    $("model").addEventListener("change", () => this.open(Number($("model").value)));
    $("scene").addEventListener("change", () => this.restart());
    $("size").addEventListener("input", () => this.showSide());
    stage.addEventListener("pointerdown", (event) => {
      const [x, y] = this.panel.pointAt(event);
      this.cursor = null;
      if (this.grab(x, y)) {
        stage.setPointerCapture(event.pointerId);
        event.preventDefault();
        stage.focus({ preventScroll: true }); // so that keys work
      }
    });
    stage.addEventListener("pointermove", (event) => this.world.hand && !this.cursor && this.world.point(...this.panel.pointAt(event)));
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, () => !this.cursor && this.release());
    stage.addEventListener("dblclick", (event) => this.addBlock(this.panel.pointAt(event)));
    stage.addEventListener("keydown", (event) => this.key(event));
    stage.addEventListener("blur", () => {
      this.release();
      this.cursor = null;
    });
    this.play(this.playing);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }, moves = arrows[event.key];
    const [[left, right], [bottom, top]] = this.model.bounds, at = this.cursor || [(left + right) / 2, (bottom + top) / 2];
    const actions = {
      p: () => this.play(!this.playing),
      s: () => $("step").click(),
      r: () => $("reset").click(),
      b: () => this.addBlock(this.cursor || this.place),
      o: () => this.addObstacle(this.cursor || this.place),
      " ": () => (this.world.hand ? this.release() : this.grab(...at) || this.say("Nothing to hold there.")),
      Delete: () => this.say({ obstacle: "Removed an obstacle.", block: "Removed a block.", "": "Nothing to remove there." }[this.world.removeAt(...at)]),
      Escape: () => $("stage").blur(),
    };
    actions.Backspace = actions.Delete;
    const action = moves || actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    if (!moves) {
      this.cursor = this.cursor || at;
      action();
      return;
    }
    const reach = CURSOR_STEP * this.world.unit * (event.shiftKey ? 4 : 1);
    this.cursor = [
      Math.min(Math.max(at[0] + reach * moves[0], left), right),
      Math.min(Math.max(at[1] + reach * moves[1], bottom), top),
    ];
    if (this.world.hand) this.world.point(...this.cursor);
  }
}

function start() {
  if (typeof WebAssembly === "undefined") {
    $("status").textContent = "This browser has no WebAssembly; take a current one.";
    return;
  }
  if (!window.gpeModels) {
    $("status").textContent = "A file of this page is missing: model_0.js, beside index.html. Copy the whole folder.";
    return;
  }
  window.gpePage = new Page(window.gpeModels);
}

start();
