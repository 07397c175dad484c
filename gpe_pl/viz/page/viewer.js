// The page: panels, time, camera and controls.

const scene = JSON.parse(document.getElementById("scene").textContent);
const $ = (id) => document.getElementById(id);
const MISSING = 65535, TITLE = 28, FOOT = 34, GAP = 4; // room around the picture of a panel [CSS pixels]

/** Parallel projection, shared by all panels: sizes do not depend on the distance. */
class Camera {
  constructor() {
    this.reset();
  }

  reset() {
    const { focus } = scene;
    this.center = focus.low.map((low, k) => (low + focus.high[k]) / 2);
    this.zoom = 1;
    this.azimuth = scene.azimuth;
    this.elevation = scene.elevation;
  }

  /** Unit vectors to the right, up and towards the viewer. */
  axes() {
    if (scene.dim === 2) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    const [sin, cos] = [Math.sin(this.azimuth), Math.cos(this.azimuth)];
    const [rise, flat] = [Math.sin(this.elevation), Math.cos(this.elevation)];
    const place = (a) => { const v = [0, 0, 0]; scene.order.forEach((axis, k) => { v[axis] = a[k]; }); return v; };
    return [place([-sin, cos, 0]), place([-rise * cos, -rise * sin, flat]), place([flat * cos, flat * sin, rise])];
  }

  /** Half of the visible width and height of the scene [m]. */
  extent() {
    const half = scene.focus.low.map((low, k) => (scene.focus.high[k] - low) / 2);
    if (scene.round) return [half[0], half[0]];
    return this.axes().slice(0, 2).map((axis) => axis.reduce((sum, a, k) => sum + Math.abs(a) * half[k], 0));
  }

  /** Uniforms for a box of the canvas, and pixels per metre. */
  view(box) {
    const [right, up, toward] = this.axes();
    const [w, h] = this.extent();
    const pixels = this.zoom * Math.max(1, Math.min((box.width - 4) / (2 * w), (box.height - 4) / (2 * h)));
    return {
      u_center: this.center, u_right: right, u_up: up, u_toward: toward, pixels,
      u_scale: [2 * pixels / box.width, 2 * pixels / box.height, scene.dim === 2 ? 0 : 1 / scene.depth],
    };
  }

  drag(dx, dy, box, pan) {
    const { pixels } = this.view(box);
    const [right, up] = this.axes();
    if (scene.dim === 3 && !pan) {
      this.azimuth -= dx * 0.008;
      this.elevation = Math.min(Math.PI / 2, Math.max(-0.2, this.elevation + dy * 0.008));
    } else {
      this.center = this.center.map((c, k) => c - (dx * right[k] - dy * up[k]) / pixels);
    }
  }

  /** Zooms about the point (x, y), measured from the middle of the box. */
  scale(factor, x, y, box) {
    const before = this.view(box);
    this.zoom = Math.min(200, Math.max(0.2, this.zoom * factor));
    const shift = 1 / before.pixels - 1 / this.view(box).pixels;
    this.center = this.center.map((c, k) => c + shift * (x * before.u_right[k] - y * before.u_up[k]));
  }
}

/** Arrays of one trajectory. */
class Recording {
  constructor(about, arrays) {
    Object.assign(this, about);
    this.arrays = Object.fromEntries(about.fields.map((field) => [field, arrays[`${about.id}_${field}`]]));
  }

  /** Positions of a frame as 16-bit integers, or null past its end. */
  pos(frame) {
    const width = scene.nodes * scene.dim;
    return frame < this.frames ? this.arrays.pos.subarray(frame * width, (frame + 1) * width) : null;
  }

  /** Position of a node [m], or null if it is not shown. */
  at(frame, node) {
    const pos = this.pos(frame);
    if (!pos || pos[node * scene.dim] === MISSING) return null;
    return [0, 1, 2].map((k) => k < scene.dim ? scene.position.low[k] + pos[node * scene.dim + k] / MISSING * scene.position.extent[k] : 0);
  }

  /** A stored quantity of every node [its unit], NaN where it has none. */
  quantity(by, frame) {
    const stored = this.arrays[by], step = scene.steps[by];
    if (!stored) return null;
    return (node) => { const q = stored[frame * scene.nodes + node]; return q === MISSING ? NaN : q * step; };
  }
}

/** Distance [m] between the positions of a node in two trajectories. */
function distance(a, b, frame) {
  const p = a.pos(frame), q = b.pos(frame), { dim } = scene;
  if (!p || !q) return null;
  const unit = scene.position.extent.map((e) => e / MISSING);
  return (node) => {
    let sum = 0;
    const first = node * dim;
    if (p[first] === MISSING || q[first] === MISSING) return NaN;
    for (let k = 0; k < dim; k++) {
      let d = (p[first + k] - q[first + k]) * unit[k];
      const period = scene.periods[k];
      if (period) d -= period * Math.round(d / period);
      sum += d * d;
    }
    return Math.sqrt(sum);
  };
}

class Viewer {
  constructor(arrays) {
    this.arrays = arrays;
    this.truth = new Recording(scene.trajectories[0], arrays);
    this.predictions = scene.trajectories.slice(1).map((about) => new Recording(about, arrays));
    this.prediction = this.predictions[0];
    this.color = scene.colors[0].by;
    this.frame = 0;
    this.camera = new Camera();
    this.renderer = new Renderer($("canvas"), scene, arrays);
    this.colors = Object.fromEntries(scene.colors.map((c) => [c.by, c]));
    this.shades = [];
    this.panels = [];
    this.#controls();
    this.#mouse();
    new ResizeObserver(() => this.#layout()).observe($("stage"));
    this.#layout();
    $("message").hidden = true;
  }

  /** Name, trajectory and colour of every panel. */
  #shown() {
    const shown = [{ name: this.truth.name, of: this.truth, by: this.color }];
    if (this.prediction) {
      shown.push({ name: this.prediction.name, of: this.prediction, by: this.color });
      shown.push({ name: scene.apart.title, of: this.prediction, by: "error" });
    }
    return shown;
  }

  #layout() {
    const { clientWidth: width, clientHeight: height } = $("stage");
    const count = this.#shown().length, [w, h] = this.camera.extent();
    let best = null;
    for (let columns = 1; columns <= count; columns++) {
      const size = { width: width / columns, height: height / Math.ceil(count / columns) };
      const scale = Math.min((size.width - 2 * GAP) / w, (size.height - TITLE - FOOT) / h);
      if (!best || scale > best.scale * 1.001) best = { ...size, columns, scale };
    }
    this.panels = this.#shown().map((panel, k) => {
      const x = (k % best.columns) * best.width, y = Math.floor(k / best.columns) * best.height;
      return { ...panel, box: { x: x + GAP, y: y + TITLE, width: best.width - 2 * GAP, height: Math.max(20, best.height - TITLE - FOOT) } };
    });
    $("overlay").replaceChildren(...this.panels.map((panel) => this.#frameOf(panel)));
    this.#drawCurve();
    this.draw();
  }

  /** Draws the frame of a panel: its name, how many nodes it does not show, the meaning of its colours, and a ring around the node under the mouse. */
  #frameOf(panel) {
    const element = document.createElement("section");
    element.className = "panel";
    const { x, y, width, height } = panel.box;
    Object.assign(element.style, { left: `${x}px`, top: `${y - TITLE}px`, width: `${width}px`, height: `${height + TITLE + FOOT}px` });
    const add = (tag, name, text = "") => { const e = document.createElement(tag); e.className = name; e.textContent = text; element.append(e); return e; };
    const title = add("div", "title"), name = document.createElement("h2");
    panel.note = document.createElement("span");
    name.textContent = panel.name;
    title.append(name, panel.note);
    if (panel.by === "material") {
      const legend = add("div", "legend");
      for (const { name, color } of scene.materials) {
        const entry = document.createElement("span"), dot = document.createElement("i");
        dot.style.background = color;
        entry.append(dot, name);
        legend.append(entry);
      }
    } else if (panel.by !== "error" || panel.of !== this.truth) {
      const { label, unit, low, high, isExceeded } = this.colors[panel.by], map = this.arrays[`map_${panel.by}`];
      const bar = add("div", "bar"), stops = [];
      for (let k = 0; k < 256; k += 15) stops.push(`rgb(${map[3 * k]},${map[3 * k + 1]},${map[3 * k + 2]})`);
      const strip = document.createElement("i");
      strip.style.background = `linear-gradient(to right, ${stops.join(",")})`;
      const end = `${isExceeded ? "≥ " : ""}${withUnit(high, unit)}`; // its colour also means all values above
      bar.append(strip, ...[withUnit(low, unit), label, end].map((text) => Object.assign(document.createElement("span"), { textContent: text })));
    }
    panel.stopped = add("div", "stopped");
    panel.ring = add("div", "ring");
    panel.ring.hidden = true;
    return element;
  }

  /** Returns the positions of all nodes on the colour map, negative for a node without a value. */
  #shade(number, { of, by }) {
    const shades = (this.shades[number] ??= new Float32Array(scene.nodes));
    const { low, high } = this.colors[by];
    const value = this.#quantity(of, by);
    for (let node = 0; node < scene.nodes; node++) {
      const v = value ? (value(node) - low) / (high - low) : -1;
      shades[node] = v >= 0 ? v : v < 0 && value ? 0 : -1; // NaN is neither
    }
    return shades;
  }

  /** Returns a function of the node, or null if the trajectory does not have the quantity. */
  #quantity(of, by) {
    if (by === "error") {
      const apart = of === this.truth ? null : distance(of, this.truth, this.frame), { all_material } = this.arrays;
      return apart && ((node) => Number.isNaN(all_material[node]) ? NaN : apart(node)); // walls that move are not predicted
    }
    const fixed = this.arrays[`all_${by}`];
    return fixed ? (node) => fixed[node] : of.quantity(by, this.frame);
  }

  draw() {
    const started = performance.now();
    this.renderer.begin();
    this.panels.forEach((panel, k) => {
      const pos = panel.of.pos(this.frame);
      const shades = pos && this.#shade(k, panel);
      this.renderer.panel(k, panel.box, this.camera.view(panel.box), pos, shades, panel.by);
      panel.stopped.hidden = Boolean(pos);
      panel.stopped.textContent = pos ? "" : panel.of.stopped;
      panel.note.textContent = pos ? panel.of.notes[this.frame] : "";
    });
    $("frame").value = this.frame;
    $("time").textContent = `${(scene.startTime + this.frame * scene.frameInterval).toFixed(scene.decimals)} s   frame ${this.frame * scene.stride}`;
    this.#markCurve();
    this.#point();
    this.drawMilliseconds = performance.now() - started; // time of this thread; the graphics card may take longer
  }

  // --- time -------------------------------------------------------------------------------------------------------------------------------

  #play(on) {
    this.playing = on && this.truth.frames > 1;
    $("play").textContent = this.playing ? "❚❚" : "▶";
    $("play").setAttribute("aria-label", this.playing ? "pause" : "play");
    if (!this.playing) return;
    if (this.frame >= this.truth.frames - 1) this.frame = 0;
    const from = { frame: this.frame, time: performance.now() };
    this.playback = from;
    const tick = (now) => {
      if (!this.playing || this.playback !== from) return;
      const seconds = Math.max(0, now - from.time) / 1000; // the first picture may have an earlier time than the click
      const frame = from.frame + Math.floor(seconds * Number($("rate").value)); // skips frames to keep time
      if (Math.min(frame, this.truth.frames - 1) !== this.frame) this.#show(frame);
      if (frame >= this.truth.frames - 1 + Number($("rate").value) / 2) Object.assign(from, { frame: 0, time: now }); // starts again after showing the last frame
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  #show(frame) {
    this.frame = Math.min(this.truth.frames - 1, Math.max(0, frame));
    this.draw();
  }

  #drawCurve() {
    const canvas = $("curve"), ratio = window.devicePixelRatio || 1, rmse = this.prediction?.rmse;
    canvas.style.display = rmse && this.truth.frames > 1 ? "" : "none";
    if (!rmse || this.truth.frames < 2) return;
    const width = canvas.width = canvas.clientWidth * ratio, height = canvas.height = canvas.clientHeight * ratio;
    const top = Math.max(...rmse.filter((e) => e !== null), 1e-30), context = canvas.getContext("2d", { willReadFrequently: true });
    context.beginPath();
    context.moveTo(0, height);
    let last = 0;
    rmse.forEach((e, k) => {
      if (e === null) return;
      last = k / (this.truth.frames - 1) * width;
      context.lineTo(last, height - e / top * (height - 2 * ratio));
    });
    context.lineTo(last, height);
    context.fillStyle = "#e8b4b4";
    context.fill();
    this.curve = context.getImageData(0, 0, width, height);
  }

  #markCurve() {
    const canvas = $("curve");
    if (!this.curve || canvas.style.display === "none") return;
    const context = canvas.getContext("2d"), x = this.frame / (this.truth.frames - 1) * canvas.width;
    context.putImageData(this.curve, 0, 0);
    context.fillStyle = "#262626";
    context.fillRect(Math.min(canvas.width - 1, Math.max(0, x - 0.5)), 0, window.devicePixelRatio || 1, canvas.height);
    const error = this.prediction.rmse[this.frame];
    $("time").textContent += error === null || error === undefined ? "" : `\n${scene.apart.title} ${withUnit(error, "m")} rms`;
  }

  // --- controls ---------------------------------------------------------------------------------------------------------------------------

  #controls() {
    const options = (select, values) => select.replaceChildren(...values.map(([value, text]) => new Option(text, value)));
    options($("color"), scene.colors.filter((c) => c.by !== "error" || this.prediction).map((c) => [c.by, c.name]));
    options($("prediction"), this.predictions.map((p, k) => [k, p.name]));
    $("prediction-label").hidden = this.predictions.length < 2;
    $("precision").textContent = `positions shown to within ${withUnit(scene.rounding, "m")}`;
    $("precision").title = "Positions are stored with 16 bits per axis; this is the largest error of that.";
    $("frame").max = this.truth.frames - 1;
    document.querySelector("footer").hidden = this.truth.frames < 2;
    $("color").addEventListener("change", (event) => { this.color = event.target.value; this.#layout(); });
    $("prediction").addEventListener("change", (event) => { this.prediction = this.predictions[event.target.value]; this.#layout(); });
    $("rate").addEventListener("change", () => this.#play(this.playing));
    $("reset").addEventListener("click", () => { this.camera.reset(); this.draw(); });
    $("play").addEventListener("click", () => this.#play(!this.playing));
    $("frame").addEventListener("input", (event) => { this.#play(false); this.#show(Number(event.target.value)); });
    document.addEventListener("keydown", (event) => {
      if (event.target.matches("select, input, button") && event.key !== " ") return;
      const target = { ArrowRight: this.frame + 1, ArrowLeft: this.frame - 1, Home: 0, End: this.truth.frames - 1 }[event.key];
      if (event.key === " " && !event.target.matches("select, button")) this.#play(!this.playing);
      else if (target !== undefined) { this.#play(false); this.#show(target); }
      else return;
      event.preventDefault();
    });
  }

  // --- mouse ------------------------------------------------------------------------------------------------------------------------------

  #mouse() {
    const stage = $("stage");
    let last = null;
    const place = (event) => { const r = stage.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; };
    const within = ([x, y]) => this.panels.find(({ box }) => x >= box.x && x < box.x + box.width && y >= box.y && y < box.y + box.height);
    stage.addEventListener("pointerdown", (event) => { last = [event.clientX, event.clientY]; stage.setPointerCapture(event.pointerId); stage.classList.add("dragging"); });
    stage.addEventListener("pointerup", () => { last = null; stage.classList.remove("dragging"); });
    stage.addEventListener("pointermove", (event) => {
      if (last) {
        this.camera.drag(event.clientX - last[0], event.clientY - last[1], this.panels[0].box, event.shiftKey || event.buttons === 2);
        last = [event.clientX, event.clientY];
        this.hovered = null;
        this.draw();
      } else {
        const [x, y] = place(event), panel = within([x, y]);
        this.hovered = panel ? this.#nearest(panel, x, y) : null;
        this.#point(x, y);
      }
    });
    stage.addEventListener("pointerleave", () => { this.hovered = null; this.#point(); });
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("dblclick", () => { this.camera.reset(); this.draw(); });
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      const [x, y] = place(event), panel = within([x, y]);
      if (!panel) return;
      const { box } = panel;
      this.camera.scale(Math.exp(-event.deltaY * 0.0015), x - box.x - box.width / 2, y - box.y - box.height / 2, box);
      this.draw();
    }, { passive: false });
  }

  /** Returns the point of a position in a panel [CSS pixels], and its distance towards the viewer [m]. */
  #onScreen(pos, { box }) {
    const view = this.camera.view(box), r = pos.map((p, k) => p - view.u_center[k]);
    const dot = (axis) => axis[0] * r[0] + axis[1] * r[1] + axis[2] * r[2];
    return [box.x + box.width / 2 + dot(view.u_right) * view.pixels, box.y + box.height / 2 - dot(view.u_up) * view.pixels, dot(view.u_toward), view.pixels];
  }

  /** Returns the node under the mouse that is nearest to the viewer. */
  #nearest(panel, x, y) {
    const origin = this.#onScreen([0, 0, 0], panel), unit = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((e) => this.#onScreen(e, panel));
    const pos = panel.of.pos(this.frame), { dim, position } = scene;
    if (!pos) return null;
    const reach = Math.max(6, 0.5 * scene.diameter * origin[3]) ** 2;
    let best = null, score = Infinity;
    for (let node = 0; node < scene.nodes; node++) {
      if (pos[node * dim] === MISSING) continue;
      let sx = origin[0], sy = origin[1], depth = 0;
      for (let k = 0; k < dim; k++) {
        const p = position.low[k] + pos[node * dim + k] / MISSING * position.extent[k];
        sx += p * (unit[k][0] - origin[0]);
        sy += p * (unit[k][1] - origin[1]);
        depth += p * (unit[k][2] - origin[2]);
      }
      const d = (sx - x) ** 2 + (sy - y) ** 2, rank = dim === 3 ? -depth : d;
      if (d <= reach && rank < score) { best = node; score = rank; }
    }
    return best;
  }

  /** Marks the node under the mouse in all panels, and shows its values. */
  #point(x, y) {
    const node = this.hovered, tooltip = $("tooltip");
    for (const panel of this.panels) {
      const pos = node === null || node === undefined ? null : panel.of.at(this.frame, node);
      panel.ring.hidden = !pos;
      if (!pos) continue;
      const [left, top, , pixels] = this.#onScreen(pos, panel), size = Math.max(10, scene.diameter * pixels + 5);
      Object.assign(panel.ring.style, { left: `${left - panel.box.x}px`, top: `${top - panel.box.y + TITLE}px`, width: `${size}px`, height: `${size}px` });
    }
    if (node === null || node === undefined) { tooltip.hidden = true; return; }
    tooltip.textContent = this.#describe(node);
    tooltip.hidden = false;
    if (x === undefined) return;
    const { clientWidth, clientHeight } = $("stage");
    tooltip.style.left = `${Math.max(0, Math.min(x + 14, clientWidth - tooltip.offsetWidth - 4))}px`;
    tooltip.style.top = `${Math.max(0, Math.min(y + 14, clientHeight - tooltip.offsetHeight - 4))}px`;
  }

  #describe(node) {
    const lines = [`node ${node} (${scene.nodeMaterials[this.arrays.all_material[node]] ?? scene.nodeMaterials.at(-1)})`];
    for (const of of this.prediction ? [this.truth, this.prediction] : [this.truth]) {
      const pos = of.at(this.frame, node);
      lines.push(`${of.name}: ${pos ? `(${pos.slice(0, scene.dim).map((p) => p.toFixed(4)).join(", ")}) m` : "not shown"}`);
      if (!pos) continue;
      for (const { by, name, unit } of scene.colors) {
        const value = by in scene.steps || by === "error" ? this.#quantity(of, by)?.(node) : undefined;
        if (value === undefined || Number.isNaN(value)) continue;
        const atLeast = scene.cut.includes(by) && value >= (MISSING - 1) * scene.steps[by] ? "≥ " : "";  // larger values are stored as the largest one
        lines.push(`   ${name} ${atLeast}${withUnit(value, unit)}`);
      }
    }
    return lines.join("\n");
  }
}

try {
  window.viewer = new Viewer(await unpack());
} catch (error) {
  $("message").textContent = `This page cannot be shown: ${error.message}`;
  $("message").hidden = false;
  throw error;
}
