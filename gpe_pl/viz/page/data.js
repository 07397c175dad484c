// Arrays of the page: base64 of zlib. See viewer.py, which packs them.

/** Returns the bytes of a packed array. */
async function inflate(element) {
  const text = atob(element.textContent);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  element.remove(); // frees the text
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Decodes values from differences between frames, modulo 2^16, with all low bytes before all high bytes. */
function integrate(bytes, width) {
  const count = bytes.length / 2;
  const values = new Uint16Array(count);
  for (let k = 0; k < count; k++) values[k] = (bytes[k] | (bytes[count + k] << 8)) + (k < width ? 0 : values[k - width]);
  return values;
}

/** Returns all arrays of the page by name. */
async function unpack() {
  const kinds = { uint8: Uint8Array, uint32: Uint32Array, float32: Float32Array };
  const arrays = {};
  for (const element of document.querySelectorAll("script[data-kind]")) {
    const { name, kind, width } = element.dataset;
    const bytes = await inflate(element);
    arrays[name] = kind === "frames" ? integrate(bytes, Number(width)) : new kinds[kind](bytes.buffer);
  }
  return arrays;
}

/** Formats a number, with an SI prefix if a unit follows. */
function withUnit(value, unit) {
  if (!unit) return String(Number(value.toPrecision(3)));
  if (value === 0) return `0 ${unit}`;
  const size = Math.max(-3, Math.min(3, Math.floor(Math.log10(Math.abs(value)) / 3 + 1e-9)));
  const scaled = Number((value / 1000 ** size).toPrecision(3));
  return `${scaled} ${["n", "µ", "m", "", "k", "M", "G"][size + 3]}${unit}`;
}
