// Draws panels with WebGL 2: one canvas, a viewport per panel.
// Positions are 16-bit integers in a range that all trajectories share; the largest value marks a node that is not shown.

const PROJECT = `
uniform vec3 u_center, u_right, u_up, u_toward;
uniform vec3 u_scale; // from metres to clip space: across, up, depth
vec4 project(vec3 pos) {
  vec3 r = pos - u_center;
  return vec4(dot(u_right, r) * u_scale.x, dot(u_up, r) * u_scale.y, -dot(u_toward, r) * u_scale.z, 1.0);
}
vec3 turned(vec3 v) { return vec3(dot(u_right, v), dot(u_up, v), dot(u_toward, v)); }
`;
const LIGHT = "const vec3 light = normalize(vec3(-0.45, 0.75, 0.5));";

const NODE_VERTEX = `#version 300 es
in vec3 a_pos; in float a_value;
uniform vec3 u_low, u_extent; uniform float u_size;
uniform sampler2D u_map; uniform vec3 u_neutral; uniform float u_haze;
out vec3 v_color; out float v_missing; out vec3 v_place;
${PROJECT}
void main() {
  v_missing = a_pos.x > 0.999995 ? 1.0 : 0.0;
  vec3 pos = u_low + a_pos * u_extent;
  gl_Position = v_missing > 0.0 ? vec4(2.0, 2.0, 2.0, 1.0) : project(pos);
  gl_PointSize = u_size;
  v_color = a_value < 0.0 ? u_neutral : texture(u_map, vec2((clamp(a_value, 0.0, 1.0) * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  v_color = mix(v_color, vec3(1.0), u_haze * clamp(0.5 + 0.5 * gl_Position.z, 0.0, 1.0));
  v_place = turned(pos - u_center);
}`;

const DISC_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_color; in float v_missing; in vec3 v_place;
uniform float u_size, u_radius_depth; uniform bool u_solid;
out vec4 color;
${LIGHT}
void main() {
  vec2 p = vec2(2.0, -2.0) * (gl_PointCoord - 0.5);
  float r = length(p);
  float cover = clamp((1.0 - r) * 0.5 * u_size + 0.5, 0.0, 1.0);
  if (v_missing > 0.0 || (u_solid ? r > 1.0 : cover <= 0.0)) discard;
  if (u_solid) {
    vec3 n = vec3(p, sqrt(max(0.0, 1.0 - r * r)));
    color = vec4(v_color * (0.72 + 0.28 * max(0.0, dot(n, light))), 1.0);
    gl_FragDepth = gl_FragCoord.z - n.z * u_radius_depth;
  } else {
    float rim = 0.25 * clamp((r - 0.8) * 0.5 * u_size + 0.5, 0.0, 1.0) * clamp((u_size - 4.0) / 4.0, 0.0, 1.0); // tells neighbours apart
    color = vec4(v_color * (1.0 - rim), cover);
    gl_FragDepth = gl_FragCoord.z;
  }
}`;

const FACE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_color; in float v_missing; in vec3 v_place;
uniform bool u_solid; uniform vec4 u_ink;
out vec4 color;
${LIGHT}
void main() {
  if (v_missing > 0.0) discard;
  if (u_ink.a > 0.0) { color = u_ink; return; }
  float shade = 1.0;
  if (u_solid) {
    vec3 n = normalize(cross(dFdx(v_place), dFdy(v_place)));
    shade = 0.8 + 0.2 * dot(n, light);
  }
  color = vec4(v_color * shade, 1.0);
}`;

const FLAT_VERTEX = `#version 300 es
in vec3 a_pos; in vec3 a_normal; in vec3 a_color;
out vec3 v_color;
${PROJECT}
void main() {
  gl_Position = project(a_pos);
  v_color = a_color;
  if (dot(a_normal, a_normal) > 0.0 && dot(a_normal, u_toward) <= 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}`;
const FLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_color; out vec4 color;
void main() { color = vec4(v_color, 1.0); }`;

// Discs on a surface, visible from its free side; overlapping discs look like the surface.
const SURFACE_VERTEX = `#version 300 es
in vec3 a_pos; in vec3 a_normal; in float a_radius;
uniform float u_pixels;
out vec3 v_normal; out float v_size;
${PROJECT}
void main() {
  v_normal = turned(a_normal);
  gl_Position = project(a_pos);
  v_size = 2.0 * a_radius * u_pixels;
  gl_PointSize = v_size;
  if (v_normal.z <= 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}`;
const SURFACE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_normal; in float v_size;
uniform float u_pixels, u_depth;
out vec4 color;
${LIGHT}
void main() {
  vec2 p = vec2(2.0, -2.0) * (gl_PointCoord - 0.5);
  vec3 n = normalize(v_normal);
  float z = -dot(n.xy, p) / max(n.z, 0.05);
  if (dot(p, p) + z * z > 1.0) discard;
  gl_FragDepth = gl_FragCoord.z - z * 0.5 * v_size / u_pixels * 0.5 * u_depth;
  color = vec4(vec3(0.7 + 0.24 * max(-0.4, dot(n, light))), 1.0);
}`;

// A 2D solid by its signed distance, in pixels of the picture.
const SOLID_VERTEX = `#version 300 es
in vec2 a_corner;
uniform vec2 u_from, u_to;
out vec2 v_texture;
${PROJECT}
void main() { v_texture = a_corner; gl_Position = project(vec3(mix(u_from, u_to, a_corner), 0.0)); }`;
const SOLID_FRAGMENT = `#version 300 es
precision highp float;
in vec2 v_texture;
uniform sampler2D u_distance; uniform float u_unit, u_pixels;
out vec4 color;
void main() {
  vec2 size = vec2(textureSize(u_distance, 0));
  float d = (texture(u_distance, (v_texture * (size - 1.0) + 0.5) / size).r - 128.0 / 255.0) * u_unit * u_pixels;
  float inside = clamp(0.5 - d, 0.0, 1.0), line = clamp(1.2 - abs(d), 0.0, 1.0);
  color = vec4(mix(vec3(0.82), vec3(0.15), line), max(inside, line));
}`;

/** Draws trajectories from the ``scene`` and ``arrays`` of the page. */
class Renderer {
  constructor(canvas, scene, arrays) {
    const gl = canvas.getContext("webgl2", { antialias: arrays.triangles.length > 0, alpha: false });
    if (!gl) throw new Error("this browser offers no WebGL 2");
    Object.assign(this, { canvas, gl, scene, arrays });
    this.solid = scene.dim === 3;
    this.programs = {
      disc: this.#program(NODE_VERTEX, DISC_FRAGMENT), face: this.#program(NODE_VERTEX, FACE_FRAGMENT),
      flat: this.#program(FLAT_VERTEX, FLAT_FRAGMENT), surface: this.#program(SURFACE_VERTEX, SURFACE_FRAGMENT),
      barrier: this.#program(SOLID_VERTEX, SOLID_FRAGMENT),
    };
    const element = (data) => data && data.length ? { buffer: this.#buffer(data, gl.ELEMENT_ARRAY_BUFFER), count: data.length } : null;
    this.loose = element(arrays.loose);
    const parts = (data, corners) => { const made = element(data); return made && { ...made, data, corners }; };
    this.triangles = parts(arrays.triangles, 3);
    this.edges = parts(arrays.edges, 2);
    this.outline = parts(arrays.outline, 2);
    const vertices = (data, width) => data && data.length ? { buffer: this.#buffer(data), count: data.length / width } : null;
    this.flats = vertices(arrays.flats, 9);
    this.lines = vertices(arrays.lines, 9);
    this.surface = vertices(arrays.surface, 7);
    this.corners = vertices(new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]), 2);
    if (scene.solid) this.distance = this.#texture(gl.R8, gl.RED, scene.solid.width, scene.solid.height, arrays.solid, gl.LINEAR);
    this.maps = Object.fromEntries(scene.colors.map((c) => [c.by, this.#texture(gl.RGB8, gl.RGB, 256, 1, arrays[`map_${c.by}`], gl.LINEAR)]));
    this.dynamic = [];
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  #shader(kind, source) {
    const { gl } = this;
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }

  #program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    gl.attachShader(program, this.#shader(gl.VERTEX_SHADER, vertex));
    gl.attachShader(program, this.#shader(gl.FRAGMENT_SHADER, fragment));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const places = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  #buffer(data, target = this.gl.ARRAY_BUFFER) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, data, gl.STATIC_DRAW);
    return buffer;
  }

  #texture(format, channels, width, height, data, filter) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, channels, gl.UNSIGNED_BYTE, data);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Selects a program and sets uniforms: numbers, booleans, and arrays of three or four. */
  #use(name, values) {
    const { gl } = this;
    const { program, places } = this.programs[name];
    gl.useProgram(program);
    for (const [key, value] of Object.entries(values)) {
      const place = places[key];
      if (!place) continue;
      if (Array.isArray(value)) gl[`uniform${value.length}fv`](place, value);
      else if (typeof value === "boolean") gl.uniform1i(place, value);
      else gl.uniform1f(place, value);
    }
    return (attributes) => {
      for (const [attribute, buffer, size, type, stride, offset, normalized] of attributes) {
        const index = gl.getAttribLocation(program, attribute);
        if (index < 0) continue;
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.enableVertexAttribArray(index);
        gl.vertexAttribPointer(index, size, type, normalized, stride, offset);
      }
    };
  }

  /** Clears the canvas and fits it to its size on the screen. */
  begin() {
    const { gl, canvas } = this;
    this.ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * this.ratio), height = Math.round(canvas.clientHeight * this.ratio);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /**
   * Draws one panel.
   * box: its place on the canvas in CSS pixels; view: of Camera.view(box);
   * pos: 16-bit positions of the frame, or null; shades: place of each node on the colour map, negative for none; by: which map.
   */
  panel(number, box, view, pos, shades, by) {
    const { gl, ratio } = this;
    const place = [box.x * ratio, this.canvas.height - (box.y + box.height) * ratio, box.width * ratio, box.height * ratio].map(Math.round);
    gl.viewport(...place);
    gl.scissor(...place);
    gl.enable(gl.SCISSOR_TEST);
    gl[this.solid ? "enable" : "disable"](gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    const { pixels, ...projection } = view;
    const shared = { ...projection, u_pixels: pixels * ratio };
    this.#scenery(shared);
    if (pos) this.#nodes(number, shared, pos, shades, by);
    if (!this.solid) this.#drawLines(shared);
  }

  #scenery(shared) {
    const { gl, scene } = this;
    if (this.distance) {
      const { low, high, unit } = scene.solid;
      gl.bindTexture(gl.TEXTURE_2D, this.distance);
      this.#use("barrier", { ...shared, u_from: low, u_to: high, u_unit: unit })([["a_corner", this.corners.buffer, 2, gl.FLOAT, 0, 0, false]]);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    if (this.solid) this.#drawLines(shared);
    if (this.flats) {
      this.#colored(shared, this.flats);
      gl.enable(gl.POLYGON_OFFSET_FILL); // keeps lines along the edges visible
      gl.polygonOffset(1, 1);
      gl.drawArrays(gl.TRIANGLES, 0, this.flats.count);
      gl.disable(gl.POLYGON_OFFSET_FILL);
    }
    if (this.surface) {
      const attributes = this.#use("surface", { ...shared, u_depth: shared.u_scale[2] });
      attributes([
        ["a_pos", this.surface.buffer, 3, gl.FLOAT, 28, 0, false],
        ["a_normal", this.surface.buffer, 3, gl.FLOAT, 28, 12, false],
        ["a_radius", this.surface.buffer, 1, gl.FLOAT, 28, 24, false],
      ]);
      gl.drawArrays(gl.POINTS, 0, this.surface.count);
    }
  }

  #colored(shared, { buffer }) {
    const { gl } = this;
    const names = ["a_pos", "a_normal", "a_color"];
    this.#use("flat", shared)(names.map((name, k) => [name, buffer, 3, gl.FLOAT, 36, 12 * k, false]));
  }

  #drawLines(shared) {
    if (!this.lines) return;
    this.#colored(shared, this.lines);
    this.gl.drawArrays(this.gl.LINES, 0, this.lines.count);
  }

  /** Writes faces or edges to the bound buffer, except those that reach across a whole periodic domain. */
  #leaveOutSeams(indices, pos) {
    const { gl, scene } = this, { data, corners } = indices, kept = [];
    const limit = scene.periods.map((period, k) => (period ? 0.5 * period / scene.position.extent[k] * 65535 : Infinity));
    for (let first = 0; first < data.length; first += corners) {
      let whole = true;
      for (let c = 1; c < corners; c++) {
        for (let k = 0; k < scene.dim; k++) {
          whole &&= Math.abs(pos[data[first + c] * scene.dim + k] - pos[data[first] * scene.dim + k]) <= limit[k];
        }
      }
      if (whole) for (let c = 0; c < corners; c++) kept.push(data[first + c]);
    }
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(kept), gl.DYNAMIC_DRAW);
    indices.count = kept.length;
  }

  #nodes(number, shared, pos, shades, by) {
    const { gl, scene } = this;
    this.dynamic[number] ??= { pos: gl.createBuffer(), shades: gl.createBuffer() };
    const own = this.dynamic[number];
    for (const [buffer, data] of [[own.pos, pos], [own.shades, shades]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    }
    const diameter = scene.diameter * shared.u_pixels;
    const size = Math.max(this.solid ? 1.5 : 1.2, diameter);
    const values = {
      ...shared, u_low: scene.position.low, u_extent: scene.position.extent, u_neutral: scene.neutral, u_haze: this.solid ? 0.3 : 0,
      u_size: size, u_solid: this.solid, u_ink: [0, 0, 0, 0], u_radius_depth: 0.25 * scene.diameter * shared.u_scale[2],
    };
    const attributes = [
      ["a_pos", own.pos, scene.dim, gl.UNSIGNED_SHORT, 0, 0, true],
      ["a_value", own.shades, 1, gl.FLOAT, 0, 0, false],
    ];
    gl.bindTexture(gl.TEXTURE_2D, this.maps[by]);
    const draw = (mode, indices) => {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices.buffer);
      if (indices.data && scene.periods.some(Boolean)) this.#leaveOutSeams(indices, pos);
      gl.drawElements(mode, indices.count, gl.UNSIGNED_INT, 0);
    };
    if (this.triangles) {
      this.#use("face", values)(attributes);
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(1, 1);
      draw(gl.TRIANGLES, this.triangles);
      gl.disable(gl.POLYGON_OFFSET_FILL);
    }
    const fine = Math.min(1, scene.spacing * shared.u_pixels / 12); // lines of small cells must not hide their colours
    if (this.edges) {
      this.#use("face", { ...values, u_ink: [0.15, 0.15, 0.15, 0.35 * fine] })(attributes);
      draw(gl.LINES, this.edges);
    }
    if (this.outline) {
      this.#use("face", { ...values, u_ink: [0.15, 0.15, 0.15, 0.9] })(attributes);
      draw(gl.LINES, this.outline);
    }
    if (this.loose) {
      this.#use("disc", values)(attributes);
      draw(gl.POINTS, this.loose);
    }
  }
}
