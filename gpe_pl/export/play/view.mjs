// Drawing: the scene on a canvas, and energies over time.

const BLOCKS = ["#c2571a", "#1f77b4", "#2a9d5c", "#8e5bb5", "#b8860b", "#d1495b"];
const INK = "#222222", SOLID = "#8a8f98", HELD = "#f4b400", SAMPLES = 240;
const SPEED_STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
export const TOP_SPEED = 3; // of the colours [m/s], in a domain of 1 m

const speedColors = Array.from({ length: 32 }, (_, k) => {
  const place = (k / 31) * (SPEED_STOPS.length - 1), first = Math.min(Math.floor(place), SPEED_STOPS.length - 2), t = place - first;
  return `rgb(${SPEED_STOPS[first].map((v, c) => Math.round(v + t * (SPEED_STOPS[first + 1][c] - v)))})`;
});

/** A canvas that shows the domain of a model, as large as its element. */
export class Panel {
  constructor(canvas, bounds) {
    this.canvas = canvas;
    this.bounds = bounds;
    this.context = canvas.getContext("2d");
  }

  /** Set the size of the canvas, and the map from metres to pixels. */
  fit() {
    const { canvas, bounds: [[left, right], [bottom, top]] } = this, density = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * density)), height = Math.max(1, Math.round(canvas.clientHeight * density));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const margin = 4 * density;
    this.scale = Math.min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom));
    this.x0 = (width - this.scale * (right - left)) / 2 - this.scale * left;
    this.y0 = height - (height - this.scale * (top - bottom)) / 2 + this.scale * bottom;
    this.density = density;
  }

  /** Return the point in metres below a pointer. */
  pointAt(event) {
    this.fit();
    const box = this.canvas.getBoundingClientRect();
    const px = (event.clientX - box.left) * this.density, py = (event.clientY - box.top) * this.density;
    return [(px - this.x0) / this.scale, (this.y0 - py) / this.scale];
  }

  draw({ shapes, pos, count, spacing, colorOf, cursor = null }) {
    this.fit();
    const { context: c, canvas, scale, x0, y0, bounds: [[left, right], [bottom, top]] } = this;
    c.clearRect(0, 0, canvas.width, canvas.height);
    const x = (value) => x0 + scale * value, y = (value) => y0 - scale * value;
    c.fillStyle = SOLID;
    for (const shape of shapes) {
      c.beginPath();
      if (shape.kind === "sphere") c.arc(x(shape.center[0]), y(shape.center[1]), scale * shape.radius, 0, 2 * Math.PI);
      if (shape.kind === "box") c.rect(x(shape.low[0]), y(shape.high[1]), scale * (shape.high[0] - shape.low[0]), scale * (shape.high[1] - shape.low[1]));
      if (shape.kind === "polygon") shape.vertices.forEach(([vx, vy]) => c.lineTo(x(vx), y(vy)));
      if (shape.kind === "bowl") {
        c.rect(x(left), y(top), scale * (right - left), scale * (top - bottom));
        c.arc(x(shape.center[0]), y(shape.center[1]), scale * shape.radius, 0, 2 * Math.PI);
      }
      c.fill("evenodd");
    }
    c.strokeStyle = INK;
    c.lineWidth = 2 * this.density;
    c.strokeRect(x(left), y(top), scale * (right - left), scale * (top - bottom));
    const radius = 0.52 * spacing * scale, byColor = new Map();
    for (let n = 0; n < count; n++) {
      const color = colorOf(n);
      if (!byColor.has(color)) byColor.set(color, new Path2D());
      const path = byColor.get(color), px = x(pos[2 * n]), py = y(pos[2 * n + 1]);
      path.moveTo(px + radius, py);
      path.arc(px, py, radius, 0, 2 * Math.PI);
    }
    for (const [color, path] of byColor) {
      c.fillStyle = color;
      c.fill(path);
    }
    if (cursor) {
      const reach = 0.03 * Math.min(right - left, top - bottom) * scale, [px, py] = [x(cursor[0]), y(cursor[1])];
      c.strokeStyle = INK;
      c.beginPath();
      c.arc(px, py, reach, 0, 2 * Math.PI);
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        c.moveTo(px + 0.5 * reach * dx, py + 0.5 * reach * dy);
        c.lineTo(px + 1.5 * reach * dx, py + 1.5 * reach * dy);
      }
      c.stroke();
    }
  }
}

/** Return the function that gives the colour of a node: by block, or by speed. Nodes in the hand have a colour of their own. */
export function colorsOf(by, { state, hand, pace }) {
  const held = hand && hand.mask, top = TOP_SPEED * pace;
  return (n) => {
    if (held && held[n]) return HELD;
    if (by === "block") return BLOCKS[state.block[n] % BLOCKS.length];
    const speed = Math.hypot(state.vel[2 * n], state.vel[2 * n + 1]);
    return speedColors[Math.min(31, Math.floor((31 * speed) / top))];
  };
}

/** The last kinetic, potential and total energies, drawn as lines. */
export class EnergyPlot {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.clear();
  }

  clear() {
    this.samples = [];
  }

  add({ kinetic, potential }) {
    this.samples.push([potential + kinetic, potential, kinetic]);
    if (this.samples.length > SAMPLES) this.samples.shift();
  }

  draw() {
    const { canvas, context: c } = this, density = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * density)), height = Math.max(1, Math.round(canvas.clientHeight * density));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    c.clearRect(0, 0, width, height);
    const top = 1.05 * Math.max(1e-9, ...this.samples.map(([total]) => total));
    ["#222222", "#1f77b4", "#c2571a"].forEach((color, line) => {
      c.strokeStyle = color;
      c.lineWidth = 1.6 * density;
      c.setLineDash(line ? [] : [4 * density, 3 * density]);
      c.beginPath();
      this.samples.forEach((values, k) => c.lineTo((k / (SAMPLES - 1)) * width, height - 2 - (values[line] / top) * (height - 4)));
      c.stroke();
    });
  }
}
