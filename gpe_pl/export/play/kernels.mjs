// Compiled loops of the network on one heap of 32-bit numbers: matrix products, and messages along edges.
//
// Arrays are numbers of bytes from the start of the heap. Rows come in multiples of 4 and columns in multiples of 8, so that loops have no remainders.
// WebAssembly does the work where the browser has 128-bit vectors; plain loops compute the same elsewhere.

export const ROWS = 4;
export const COLUMNS = 8;
const PAGE_BYTES = 65536;

export const padded = (count, multiple) => Math.ceil(count / multiple) * multiple;

/** Memory that the kernels share, and its next free byte. */
export class Heap {
  constructor() {
    this.memory = new WebAssembly.Memory({ initial: 16 });
    this.end = 16;
    this.view();
  }

  view() {
    this.f32 = new Float32Array(this.memory.buffer);
    this.i32 = new Int32Array(this.memory.buffer);
  }

  /** Return the address of a new array of zeros. */
  take(count) {
    const address = this.end;
    this.end += padded(4 * count, 16);
    const missing = this.end - this.memory.buffer.byteLength;
    if (missing > 0) {
      this.memory.grow(Math.ceil(Math.max(missing, this.memory.buffer.byteLength / 2) / PAGE_BYTES));
      this.view();
    }
    this.f32.fill(0, address / 4, this.end / 4);
    return address;
  }
}

/** A matrix on the heap: address, and bytes from row to row. */
export class Matrix {
  constructor(heap, rows, columns) {
    this.columns = padded(columns, COLUMNS);
    this.stride = 4 * this.columns;
    this.at = heap.take(padded(rows, ROWS) * this.columns);
  }
}

// --- WebAssembly: the two loops, written as instructions ----------------------------------------------------------------------------------------

const I32 = 0x7f, F32 = 0x7d, V128 = 0x7b;

const unsigned = (n) => {
  const bytes = [];
  for (; n > 127; n >>>= 7) bytes.push((n & 127) | 128);
  return [...bytes, n];
};

const get = (local) => [0x20, ...unsigned(local)];
const set = (local, ...value) => [...value.flat(), 0x21, ...unsigned(local)];
const int = (n) => [0x41, ...unsigned(n)]; // below 64, so that the sign bit is clear
const binary = (...code) => (a, b) => [...a, ...b, ...code];
const add = binary(0x6a), times = binary(0x6c), isBelow = binary(0x49);
const load = (address, offset = 0) => [...address, 0xfd, 0x00, 4, ...unsigned(offset)];
const loadInt = (address) => [...address, 0x28, 2, 0];
const splatAt = (address) => [...address, 0xfd, 0x09, 2, 0];
const store = (address, value, offset = 0) => [...address, ...value, 0xfd, 0x0b, 4, ...unsigned(offset)];
const plus = binary(0xfd, 0xe4, 1), minus = binary(0xfd, 0xe5, 1), product = binary(0xfd, 0xe6, 1);
const smaller = binary(0xfd, 0xe8, 1), larger = binary(0xfd, 0xe9, 1);
const ZERO = [0xfd, 0x0c, ...new Array(16).fill(0)];
const splat = (value) => [...value, 0xfd, 0x13];
const activated = (value, slope) => plus(larger(get(value), ZERO), product(smaller(get(value), ZERO), get(slope)));
const choose = (condition, yes, no) => [...condition, 0x04, 0x40, ...yes.flat(), 0x05, ...no.flat(), 0x0b];

/** Repeat instructions while a local, which grows by ``step`` after each pass, is below a limit; it starts at 0. Does nothing if the limit is 0. */
const loop = (local, limit, step, ...body) => [
  ...set(local, int(0)),
  ...choose(limit, [[0x03, 0x40, ...body.flat(), ...set(local, add(get(local), step)), ...isBelow(get(local), limit), 0x0d, 0, 0x0b]], []),
];

function productCode() {
  const [out, outStride, x, xStride, w, n, k, width, bias, slope] = [...Array(10).keys()];
  const ints = ["r", "c", "kk", "wp", "o0", "o1", "o2", "o3", "x0", "x1", "x2", "x3", "rowX", "rowOut"];
  const v = Object.fromEntries(ints.map((name, index) => [name, 10 + index]));
  const acc = [...Array(8).keys()].map((index) => 24 + index), w0 = 32, w1 = 33, s = 34, a = 35;
  const o = [v.o0, v.o1, v.o2, v.o3], xs = [v.x0, v.x1, v.x2, v.x3];
  const rows = [0, 1, 2, 3];
  return {
    parameters: [...Array(9).fill(I32), F32],
    locals: [...Array(14).fill(I32), ...Array(12).fill(V128)],
    body: [
      ...set(a, splat(get(slope))),
      ...set(v.rowX, get(x)), ...set(v.rowOut, get(out)),
      ...loop(v.r, get(n), int(4),
        loop(v.c, get(width), int(32),
          ...rows.map((i) => set(o[i], add(add(get(v.rowOut), get(v.c)), times(get(outStride), int(i))))),
          ...rows.map((i) => set(xs[i], add(get(v.rowX), times(get(xStride), int(i))))),
          choose(get(bias),
            rows.flatMap((i) => [0, 1].map((h) => set(acc[2 * i + h], load(add(get(bias), get(v.c)), 16 * h)))),
            rows.flatMap((i) => [0, 1].map((h) => set(acc[2 * i + h], load(get(o[i]), 16 * h))))),
          set(v.wp, add(get(w), get(v.c))),
          loop(v.kk, get(k), int(1),
            set(w0, load(get(v.wp))), set(w1, load(get(v.wp), 16)),
            ...rows.flatMap((i) => [
              set(s, splatAt(get(xs[i]))),
              set(acc[2 * i], plus(get(acc[2 * i]), product(get(s), get(w0)))),
              set(acc[2 * i + 1], plus(get(acc[2 * i + 1]), product(get(s), get(w1)))),
              set(xs[i], add(get(xs[i]), int(4))),
            ]),
            set(v.wp, add(get(v.wp), get(width)))),
          ...rows.flatMap((i) => [0, 1].map((h) => store(get(o[i]), activated(acc[2 * i + h], a), 16 * h)))),
        set(v.rowX, add(get(v.rowX), times(get(xStride), int(4)))),
        set(v.rowOut, add(get(v.rowOut), times(get(outStride), int(4))))),
    ],
  };
}

function messagesCode() {
  const [edge, target, source, count, width, a, aStride, b, bStride, atTarget, tStride, atSource, sStride, slope] = [...Array(14).keys()];
  const [k, c, i, j, e, pa, pb, pt, ps, from] = [...Array(10).keys()].map((index) => 14 + index), z = 24, s = 25;
  const moved = (pointer) => add(get(pointer), get(c));
  return {
    parameters: [...Array(13).fill(I32), F32],
    locals: [...Array(10).fill(I32), V128, V128],
    body: [
      ...set(s, splat(get(slope))), ...set(e, get(edge)), ...set(from, int(0)),
      ...loop(k, get(count), int(1),
        set(i, loadInt(add(get(target), get(from)))), set(j, loadInt(add(get(source), get(from)))),
        set(pa, add(get(a), times(get(i), get(aStride)))), set(pb, add(get(b), times(get(j), get(bStride)))),
        set(pt, add(get(atTarget), times(get(i), get(tStride)))), set(ps, add(get(atSource), times(get(j), get(sStride)))),
        loop(c, get(width), int(16),
          set(z, plus(load(moved(e)), plus(load(moved(pa)), load(moved(pb))))),
          set(z, activated(z, s)),
          store(moved(pt), plus(load(moved(pt)), get(z))),
          store(moved(ps), minus(load(moved(ps)), get(z)))),
        set(e, add(get(e), get(width))), set(from, add(get(from), int(4)))),
    ],
  };
}

/** Return a WebAssembly module with these functions, which import their memory. */
function assembled(functions) {
  const sized = (bytes) => [...unsigned(bytes.length), ...bytes];
  const section = (code, items) => [code, ...sized([...unsigned(items.length), ...items.flat()])];
  const text = (name) => sized([...name].map((letter) => letter.charCodeAt(0)));
  const entries = Object.entries(functions);
  return new Uint8Array([
    0, 0x61, 0x73, 0x6d, 1, 0, 0, 0,
    ...section(1, entries.map(([, f]) => [0x60, ...sized(f.parameters), 0])),
    ...section(2, [[...text("m"), ...text("m"), 2, 0, 1]]),
    ...section(3, entries.map((_, index) => [index])),
    ...section(7, entries.map(([name], index) => [...text(name), 0, index])),
    ...section(10, entries.map(([, f]) => sized([...unsigned(f.locals.length), ...f.locals.flatMap((type) => [1, type]), ...f.body, 0x0b]))),
  ]);
}

// --- the same as plain loops --------------------------------------------------------------------------------------------------------------------

function plainKernels(heap) {
  return {
    product(out, outStride, x, xStride, w, n, k, width, bias, slope) {
      const h = heap.f32, m = width / 4;
      for (let r = 0; r < n; r++) {
        const o = (out + r * outStride) / 4, from = (x + r * xStride) / 4;
        if (bias) for (let c = 0; c < m; c++) h[o + c] = h[bias / 4 + c];
        for (let q = 0; q < k; q++) {
          const s = h[from + q], row = w / 4 + q * m;
          for (let c = 0; c < m; c++) h[o + c] += s * h[row + c];
        }
        if (slope !== 1) for (let c = 0; c < m; c++) if (h[o + c] < 0) h[o + c] *= slope;
      }
    },
    messages(edge, target, source, count, width, a, aStride, b, bStride, atTarget, tStride, atSource, sStride, slope) {
      const h = heap.f32, m = width / 4;
      for (let k = 0; k < count; k++) {
        const i = heap.i32[target / 4 + k], j = heap.i32[source / 4 + k], e = edge / 4 + k * m;
        const pa = (a + i * aStride) / 4, pb = (b + j * bStride) / 4, pt = (atTarget + i * tStride) / 4, ps = (atSource + j * sStride) / 4;
        for (let c = 0; c < m; c++) {
          const z = h[e + c] + h[pa + c] + h[pb + c], message = z < 0 ? slope * z : z;
          h[pt + c] += message;
          h[ps + c] -= message;
        }
      }
    },
  };
}

/** Return the kernels of a heap; ``plain`` takes the plain loops also where WebAssembly has vectors. */
export function kernelsOf(heap, plain = false) {
  const code = plain ? null : assembled({ product: productCode(), messages: messagesCode() });
  if (!code || !WebAssembly.validate(code)) return { ...plainKernels(heap), compiled: false };
  const { exports } = new WebAssembly.Instance(new WebAssembly.Module(code), { m: { m: heap.memory } });
  return { product: exports.product, messages: exports.messages, compiled: true };
}
