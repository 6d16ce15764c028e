// A viewer of 3D Gaussian splats in WebGL 2, without dependencies. The page around it holds a .nsvq file (#file, base64),
// its reader (#decoder, the global `nsvq`) and cameras, background and up direction (#scene, JSON).
//
// Pictures are those of nsvq_lightning/rendering: the same projection, blur, sampling and cut-offs, with one difference: a
// pixel is not finished when its transmittance falls below 1e-4, as blending goes from back to front.
//
// Cameras have COLMAP's axes inside: x right, y down, z forward. JSON has nerfstudio's: x right, y up, z backward.
"use strict";

// ---------------------------------------------------------------------------------------------- vectors

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** a + b · scale */
const plus = (a, b, scale = 1) => [a[0] + b[0] * scale, a[1] + b[1] * scale, a[2] + b[2] * scale];
const times = (a, scale) => [a[0] * scale, a[1] * scale, a[2] * scale];
const unit = (a) => times(a, 1 / Math.hypot(...a));
/** `a` turned about the unit vector `axis`, right-handed, radians. */
const turned = (a, axis, angle) =>
  plus(plus(times(a, Math.cos(angle)), cross(axis, a), Math.sin(angle)), axis, dot(axis, a) * (1 - Math.cos(angle)));

// ---------------------------------------------------------------------------------------------- decoding and sorting

const ROW = 2048; // splats in a row of the textures: the width that every WebGL 2 has

// The functions before `startEngine` also run in the worker, as source text.

/** Rows of the textures, with room for at least one transparent splat after the last one. */
function rowsFor(count) {
  return Math.floor(count / ROW) + 1;
}

/**
 * Distance of each splat from the nearest and from the farthest camera of training, as one number: two of 12 bits, logarithms
 * in steps of 1.1 %. Between cameras there have been others: distances reach as much farther as cameras are apart.
 */
function trainedFrom(count, means, cameras) {
  const apart = cameras.map((a) => Math.min(...cameras.map((b) => (a === b ? Infinity : Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2])))));
  const gap = cameras.length > 1 ? apart.sort((a, b) => a - b)[(cameras.length - 1) >> 1] : 0;
  const code = (distance, round) => Math.min(4095, Math.max(0, round(64 * (Math.log2(distance) + 24))));
  const distances = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    let nearest = Infinity, farthest = 0;
    for (const [x, y, z] of cameras) {
      const dx = means[3 * i] - x, dy = means[3 * i + 1] - y, dz = means[3 * i + 2] - z, squared = dx * dx + dy * dy + dz * dz;
      nearest = Math.min(nearest, squared);
      farthest = Math.max(farthest, squared);
    }
    nearest = Math.sqrt(nearest);
    distances[i] = 4096 * code(Math.max(nearest - gap, nearest / 2), Math.floor) + code(Math.sqrt(farthest) + gap, Math.ceil);
  }
  return distances;
}

/** From what the file stores to what is drawn, in place: opacities, axis lengths, unit quaternions; and distances of training. */
function activate(splats) {
  const { count, means, opacities, scales, quats, header } = splats;
  splats.distances = trainedFrom(count, means, header.cameras ?? []);
  for (let i = 0; i < count; i++) {
    opacities[i] = 1 / (1 + Math.exp(-opacities[i]));
    const q = quats.subarray(4 * i, 4 * i + 4), norm = Math.hypot(...q);
    if (norm > 0) for (let k = 0; k < 4; k++) q[k] /= norm;
    else q[0] = 1;
  }
  for (let i = 0; i < scales.length; i++) scales[i] = Math.exp(scales[i]);
  return splats;
}

/** The places of the largest to the smallest of the first `count` values, which are changed: two passes of 16 bits. */
function descending(values, count) {
  const keys = new Uint32Array(values.buffer), byLow = new Uint32Array(count), order = new Uint32Array(count);
  const low = new Uint32Array(65537), high = new Uint32Array(65537);
  for (let i = 0; i < count; i++) {
    keys[i] ^= keys[i] >>> 31 ? 0xffffffff : 0x80000000; // unsigned integers in the order of the numbers
    low[(keys[i] & 0xffff) + 1]++;
    high[(keys[i] >>> 16) + 1]++;
  }
  for (let k = 0; k < 65536; k++) {
    low[k + 1] += low[k];
    high[k + 1] += high[k];
  }
  for (let i = 0; i < count; i++) byLow[low[keys[i] & 0xffff]++] = i;
  for (let i = 0; i < count; i++) order[count - 1 - high[keys[byLow[i]] >>> 16]++] = byLow[i];
  return order;
}

/**
 * A function that sorts splats from far to near along a direction: all, or the share of them that shows most. The rest of
 * the texture's last row is filled with the index after the last splat, which is a transparent one.
 */
function makeSorter({ count, means, opacities, scales }) {
  const numbers = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const [a, b, c] = scales.subarray(3 * i, 3 * i + 3);
    numbers[i] = opacities[i] * Math.max(a * b, b * c, c * a);
  }
  const ranked = descending(numbers, count), places = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) places[3 * i + k] = means[3 * ranked[i] + k];
  return ([x, y, z], share) => {
    const some = Math.ceil(count * share), order = new Uint32Array(rowsFor(some) * ROW);
    for (let i = 0, m = 0; i < some; i++, m += 3) numbers[i] = x * places[m] + y * places[m + 1] + z * places[m + 2];
    descending(numbers, some).forEach((place, i) => (order[i] = ranked[place]));
    return order.fill(count, some);
  };
}

/** The body of the worker: it decodes the file it is sent first, then sorts along the directions it is sent. */
function serve() {
  let sort = null;
  onmessage = async ({ data }) => {
    try {
      if (sort) {
        const order = sort(...data);
        postMessage({ result: order }, [order.buffer]);
      } else {
        const splats = activate(await nsvq.decode(data));
        sort = makeSorter(splats);
        postMessage({ result: splats }, [...new Set(Object.values(splats).map((part) => part.buffer).filter(Boolean))]);
      }
    } catch (error) {
      postMessage({ error: String(error.message ?? error) });
    }
  };
  postMessage({ result: null });
}

/** `{decode(buffer), sort(direction, share), end()}`, promises but the last: in a worker, or here where the browser allows none. */
async function startEngine(decoderSource) {
  try {
    const source = [`"use strict"; const ROW = ${ROW};`, decoderSource, rowsFor, trainedFrom, activate, descending, makeSorter, `(${serve})();`].join("\n");
    const worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
    const waiting = [];
    const reply = () => new Promise((resolve, reject) => waiting.push({ resolve, reject }));
    worker.onmessage = ({ data }) => {
      const { resolve, reject } = waiting.shift();
      if ("error" in data) reject(new Error(data.error));
      else resolve(data.result);
    };
    worker.onerror = (event) => waiting.splice(0).forEach(({ reject }) => reject(new Error(event.message)));
    const started = reply();
    await started;
    const ask = (message, transfer) => {
      worker.postMessage(message, transfer);
      return reply();
    };
    const end = () => worker.terminate();
    return { decode: (buffer) => ask(buffer, [buffer]), sort: (...what) => ask(what), end };
  } catch {
    let sort;
    const decode = async (buffer) => {
      const splats = activate(await nsvq.decode(buffer));
      sort = makeSorter(splats);
      return splats;
    };
    return { decode, sort: async (...what) => sort(...what), end: () => {} };
  }
}

// ---------------------------------------------------------------------------------------------- drawing

const GROUP = 128; // splats in an instance: GPUs are slow at instances of a few vertices

const FULL_SCREEN = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

/** Colour of each splat as seen from `eye`: one pixel of a texture each. */
const COLOUR = (degree) => `#version 300 es
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray geometry, harmonics;
uniform vec3 eye;
out vec4 colour;

vec3 coefficient(int k) { return texelFetch(harmonics, ivec3(gl_FragCoord.xy, k), 0).rgb; }

void main() {
  vec3 d = texelFetch(geometry, ivec3(gl_FragCoord.xy, 0), 0).xyz - eye;
  d *= inversesqrt(max(dot(d, d), 1e-20));
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.5 + 0.28209479177387814 * coefficient(0);
#if ${degree} > 0
  sum += 0.4886025119029199 * (z * coefficient(2) - y * coefficient(1) - x * coefficient(3));
#endif
#if ${degree} > 1
  sum += 1.0925484305920792 * (x * y * coefficient(4) - y * z * coefficient(5) - x * z * coefficient(7))
    + 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(6)
    + 0.5462742152960396 * (xx - yy) * coefficient(8);
#endif
#if ${degree} > 2
  sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(9) + x * (xx - 3.0 * yy) * coefficient(15))
    + 2.890611442640554 * x * y * z * coefficient(10)
    - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(11) + x * coefficient(13))
    + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12)
    + 1.445305721320277 * z * (xx - yy) * coefficient(14);
#endif
  colour = vec4(max(sum, 0.0), 1);
}`;

/**
 * A rectangle along the axes of each splat's ellipse, as large as the area where its opacity reaches 1/255. The blur of 0.3
 * square pixels belongs to the pixels of training, and there are `ratio` as many here: more is added where that is above 1, and
 * opacities shrink where it is below. With "antialiased", none of the blur was trained; "plain" does not know.
 */
const SPLAT = (trained) => `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
uniform sampler2DArray geometry;
uniform sampler2D colours;
uniform highp usampler2D order;
uniform mat3 rotation;     // world to camera
uniform vec3 translation;
uniform vec2 size;         // of the picture, pixels
uniform vec4 lens;         // fx, fy, cx, cy, pixels
uniform vec4 slopes;       // lowest x/z and y/z of a photo and its margin, then the highest
uniform float near;        // nothing is seen before it
uniform float enlarged;    // (focal length here / in training)^2
flat out vec4 colour;      // opacity last
out vec2 offset;           // from the centre, standard deviations along the axes of the ellipse

void main() {
  gl_Position = vec4(0, 0, 2, 1);  // outside: nothing is drawn unless what follows says where
  int place = gl_InstanceID * ${GROUP} + (gl_VertexID >> 2);
  int index = int(texelFetch(order, ivec2(place % ${ROW}, place / ${ROW}), 0).r);
  ivec2 at = ivec2(index % ${ROW}, index / ${ROW});
  vec4 mean = texelFetch(geometry, ivec3(at, 0), 0), q = texelFetch(geometry, ivec3(at, 1), 0);
  vec4 deviations = texelFetch(geometry, ivec3(at, 2), 0);
  vec3 centre = rotation * mean.xyz + translation;
  float z = centre.z, reach = 2.0 * log(mean.w * 255.0);
  if (!(z > near) || !(reach > 0.0)) return;

  mat3 axes = rotation * mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  axes = transpose(mat3(axes[0] * deviations.x, axes[1] * deviations.y, axes[2] * deviations.z));
  vec2 slope = clamp(centre.xy / z, slopes.xy, slopes.zw);
  vec3 u = lens.x / z * (axes[0] - slope.x * axes[2]), v = lens.y / z * (axes[1] - slope.y * axes[2]);
  float xx = dot(u, u), xy = dot(u, v), yy = dot(v, v);
  if (!(xx + yy < 1e18)) return;
  float ratio = ${{ plain: "1.0", antialiased: "0.0", sampled: "enlarged" }[trained]};
#if ${Number(trained === "sampled")}
  vec2 trained = exp2(vec2(floor(deviations.w / 4096.0), mod(deviations.w, 4096.0)) / 64.0 - 24.0);
  float away = length(centre), times = clamp(away, trained.x, trained.y) / away;
  ratio *= times * times;
#endif
  float added = 0.3 * max(ratio, 1.0), kept = 0.3 * ratio;
  vec3 normal = cross(u, v);  // |u x v|^2 = xx yy - xy^2, without its loss of digits
  float area = dot(normal, normal), determinant = area + added * (xx + yy + added), opacity = mean.w;
  if (ratio < 1.0) opacity *= sqrt((area + kept * (xx + yy + kept)) / determinant);
  reach = 2.0 * log(opacity * 255.0);
  if (!(reach > 0.0)) return;
  float half_difference = 0.5 * (xx - yy), root = length(vec2(half_difference, xy));
  float longest = 0.5 * (xx + yy) + added + root;
  vec2 axis = half_difference >= 0.0 ? vec2(half_difference + root, xy) : vec2(xy, root - half_difference);
  axis = root > 0.0 ? normalize(axis) : vec2(1, 0);

  offset = sqrt(reach) * (vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0);
  vec2 pixel = lens.xy * centre.xy / z + lens.zw
    + offset.x * sqrt(longest) * axis + offset.y * sqrt(determinant / longest) * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0, 1);
  colour = vec4(texelFetch(colours, at, 0).rgb, opacity);
}`;

const BLEND = `#version 300 es
precision highp float;
uniform float lost;  // share of what is behind that a device loses at each splat
flat in vec4 colour;
in vec2 offset;
out vec4 pixel;
void main() {
  float alpha = colour.a * exp(-0.5 * dot(offset, offset));
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, 0.99);
  pixel = vec4(colour.rgb * alpha, alpha - lost);
}`;

/** Takes a ten-thousandth from what is there, less than 16-bit floats tell from 1. */
const FAINT = `#version 300 es
precision highp float;
out vec4 pixel;
void main() { pixel = vec4(0, 0, 0, 1e-4); }`;

const SHOW = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec2 scale;  // texture coordinates a pixel
out vec4 pixel;
void main() { pixel = vec4(texture(picture, gl_FragCoord.xy * scale).rgb, 1); }`;

/** Draws splats into a canvas. `splats` as decoded, with rotations normalised, opacities and scales not raw. */
class Renderer {
  constructor(canvas, splats) {
    const options = { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) {
      throw new Error("This browser offers no WebGL 2, which this page needs. Update it, or allow it to use the GPU.");
    }
    this.gl = gl;
    this.canvas = canvas;
    this.made = [];
    this.rows = rowsFor(splats.count);
    if (this.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error(`This device cannot show more than ${gl.getParameter(gl.MAX_TEXTURE_SIZE) * ROW} splats.`);
    }
    // Eight bits would lose faint splats and add up to visible steps.
    const fine = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.format = fine ? gl.RGBA16F : gl.RGBA8;
    this.#upload(splats);
    this.colours = this.#target(2, ROW, this.rows);
    this.colour = this.#program(FULL_SCREEN, COLOUR(splats.shDegree), { geometry: 0, harmonics: 1 });
    const { config, cameras = [] } = splats.header;
    this.focals = config?.antialiased === true ? [] : cameras.map((camera) => camera[3]);
    const trained = config?.antialiased === true ? "antialiased" : cameras.length ? "sampled" : "plain";
    this.splat = this.#program(SPLAT(trained), BLEND, { geometry: 0, colours: 2, order: 4 });
    this.show = this.#program(FULL_SCREEN, SHOW, { picture: 3 });
    if (fine && this.#cuts()) {
      gl.useProgram(this.splat.program);
      gl.uniform1f(this.splat.at.lost, 2 ** -12 / Math.LN2); // half of the last of 11 bits, on average
    }
    const corners = Uint16Array.from({ length: 6 * GROUP }, (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.activeTexture(gl.TEXTURE4);
    gl.bindTexture(gl.TEXTURE_2D, this.#texture());
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, ROW, this.rows);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (gl.getError() !== gl.NO_ERROR) throw new Error("This device has too little memory for the scene.");
  }

  /** A texture that goes with the scene. */
  #texture() {
    this.made.push(this.gl.createTexture());
    return this.made.at(-1);
  }

  /** Free what the scene takes on the GPU. */
  release() {
    for (const texture of [...this.made, this.colours.texture, this.picture?.texture]) this.gl.deleteTexture(texture ?? null);
    for (const buffer of [this.colours.buffer, this.picture?.buffer]) this.gl.deleteFramebuffer(buffer ?? null);
    for (const { program } of [this.colour, this.splat, this.show]) this.gl.deleteProgram(program);
  }

  /** Geometry as float32: centre and opacity, rotation, axes and distances of training. Harmonics as float16: a layer for each coefficient. */
  #upload({ count, means, opacities, quats, scales, distances, sh0, shN, shDegree }) {
    const gl = this.gl;
    const layer = (channels, parts) => {
      const texels = new Float32Array(ROW * this.rows * channels);
      for (const { values, width, stride = width, from = 0, at = 0 } of parts) {
        for (let i = 0; i < count; i++) {
          for (let k = 0; k < width; k++) texels[i * channels + at + k] = values[i * stride + from + k];
        }
      }
      return texels;
    };
    const texture = (slot, format, channels, layers) => {
      gl.activeTexture(gl.TEXTURE0 + slot);
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.#texture());
      gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, format, ROW, this.rows, layers.length);
      const kind = channels === 4 ? gl.RGBA : gl.RGB;
      layers.forEach((parts, k) => {
        const texels = layer(channels, parts);
        gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, ROW, this.rows, 1, kind, gl.FLOAT, texels);
      });
      gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    };
    const centres = [{ values: means, width: 3 }, { values: opacities, width: 1, at: 3 }];
    const sizes = [{ values: scales, width: 3 }, { values: distances, width: 1, at: 3 }];
    texture(0, gl.RGBA32F, 4, [centres, [{ values: quats, width: 4 }], sizes]);
    const higher = (shDegree + 1) ** 2 - 1;
    const harmonics = [[{ values: sh0, width: 3 }]];
    for (let k = 0; k < higher; k++) harmonics.push([{ values: shN, width: 3, stride: 3 * higher, from: 3 * k }]);
    texture(1, gl.RGB16F, 3, harmonics);
  }

  /** A texture to draw into, bound to a unit. */
  #target(slot, width, height) {
    const gl = this.gl, texture = gl.createTexture(), buffer = gl.createFramebuffer();
    gl.activeTexture(gl.TEXTURE0 + slot);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    return { texture, buffer, width, height };
  }

  /** A program as a function `name -> location`; its samplers read the given texture units. */
  #program(vertex, fragment, samplers) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`This device's graphics driver refuses the page's shaders: ${logs.join(" ")}`);
    }
    gl.useProgram(program);
    for (const [name, slot] of Object.entries(samplers)) gl.uniform1i(gl.getUniformLocation(program, name), slot);
    const names = ["eye", "rotation", "translation", "size", "lens", "slopes", "near", "enlarged", "scale", "lost"];
    const at = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    return { program, at };
  }

  /** Whether this device cuts off what 16-bit floats have no digits for, where others round: Direct3D may, and some drivers do. */
  #cuts() {
    const gl = this.gl, read = new Float32Array(4), { texture, buffer } = this.#target(3, 1, 1);
    const { program } = this.#program(FULL_SCREEN, FAINT, {});
    gl.viewport(0, 0, 1, 1);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.BLEND);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, read);
    gl.deleteFramebuffer(buffer);
    gl.deleteTexture(texture);
    gl.deleteProgram(program);
    return read[0] < 1;
  }

  /** Splats from far to near, all or some of them: whole rows. */
  setOrder(order) {
    const gl = this.gl;
    this.drawn = order.length;
    gl.activeTexture(gl.TEXTURE4);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, order.length / ROW, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
  }

  /** (Focal length / that of the most similar photos)^2; less than one percent does not count. */
  #enlarged(focal) {
    const off = (ratio) => Math.abs(Math.log(ratio));
    const ratio = this.focals.reduce((best, other) => (off(focal / other) < off(best) ? focal / other : best), Infinity);
    return off(ratio) < 0.01 ? 1 : ratio * ratio;
  }

  /** Draw what a camera (`view` below) sees over `background`, with `share` of the canvas's resolution. */
  draw({ position, axes, near, frame, fx, fy, cx, cy }, background, share) {
    const gl = this.gl, { width, height } = this.canvas;
    if (this.picture?.width !== width || this.picture?.height !== height) {
      if (this.picture) {
        gl.deleteTexture(this.picture.texture);
        gl.deleteFramebuffer(this.picture.buffer);
      }
      this.picture = this.#target(3, width, height);
    }
    if (!this.eye || this.eye.some((x, k) => x !== position[k])) {
      this.eye = position;
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.colours.buffer);
      gl.viewport(0, 0, ROW, this.rows);
      gl.useProgram(this.colour.program);
      gl.uniform3fv(this.colour.at.eye, position);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    const size = [Math.round(width * share), Math.round(height * share)];
    const [sx, sy] = [size[0] / width, size[1] / height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.picture.buffer);
    gl.viewport(0, 0, ...size);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.splat.program);
    gl.uniformMatrix3fv(this.splat.at.rotation, true, axes.flat());
    gl.uniform3fv(this.splat.at.translation, axes.map((axis) => -dot(axis, position)));
    gl.uniform2f(this.splat.at.size, ...size);
    gl.uniform4f(this.splat.at.lens, fx * sx, fy * sy, cx * sx, cy * sy);
    const [w, h] = [frame.width, frame.height];
    const low = [(-frame.cx - 0.15 * w) / frame.fx, (-frame.cy - 0.15 * h) / frame.fy];
    gl.uniform4f(this.splat.at.slopes, ...low, low[0] + (1.3 * w) / frame.fx, low[1] + (1.3 * h) / frame.fy);
    gl.uniform1f(this.splat.at.near, near);
    gl.uniform1f(this.splat.at.enlarged, this.#enlarged(Math.sqrt(fx * sx * fy * sy)));
    gl.enable(gl.BLEND);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * GROUP, gl.UNSIGNED_SHORT, 0, this.drawn / GROUP);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(this.show.program);
    gl.uniform2f(this.show.at.scale, sx / width, sy / height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// ---------------------------------------------------------------------------------------------- cameras

/** Where the viewer is and what its lens sees; `frame` is the picture that stays in view whatever the window's shape. */
class ViewPoint {
  constructor(up, near) {
    this.up = unit(up);
    this.near = near;
  }

  /** Take over a camera as JSON has it. */
  set({ camera_to_world: m, width, height, fx, fy, cx, cy }) {
    this.axes = [[m[0], m[4], m[8]], [-m[1], -m[5], -m[9]], [-m[2], -m[6], -m[10]]]; // right, down, forward
    this.position = [m[3], m[7], m[11]];
    this.frame = { width, height, fx, fy, cx, cy };
  }

  /** The camera for a picture of `width` by `height` pixels in which the whole frame is visible, as JSON has it. */
  camera(width, height) {
    const [r, d, f] = this.axes, p = this.position;
    const rows = [0, 1, 2].map((k) => [r[k], -d[k], -f[k], p[k]]);
    return { camera_to_world: [...rows.flat(), 0, 0, 0, 1], width, height, ...this.lens(width, height) };
  }

  lens(width, height) {
    const { width: w, height: h, fx, fy, cx, cy } = this.frame;
    const scale = Math.min(width / w, height / h);
    return { fx: fx * scale, fy: fy * scale, cx: width / 2 + (cx - w / 2) * scale, cy: height / 2 + (cy - h / 2) * scale };
  }

  /** Turn about the point `distance` ahead; radians to the right about the up direction, and upwards. */
  orbit(yaw, pitch) {
    const pivot = plus(this.position, this.axes[2], this.distance);
    const turn = (axis, angle) => (this.axes = this.axes.map((a) => turned(a, axis, angle)));
    turn(this.up, yaw);
    const before = Math.abs(dot(this.axes[2], this.up));
    const after = Math.abs(dot(turned(this.axes[2], this.axes[0], pitch), this.up));
    if (after < 0.998 || after < before) turn(this.axes[0], pitch); // not over the poles
    const forward = unit(this.axes[2]), right = unit(cross(this.axes[1], forward));
    this.axes = [right, cross(forward, right), forward];
    this.position = plus(pivot, forward, -this.distance);
  }

  /** Move along the camera's own axes, scene units. */
  move(right, down, forward) {
    [right, down, forward].forEach((step, k) => (this.position = plus(this.position, this.axes[k], step)));
  }

  /** Come so much nearer (factor < 1) or go farther; never stuck at the point it turns about. */
  zoom(factor) {
    this.move(0, 0, this.distance * (1 - factor));
    this.distance = Math.max(this.distance * factor, this.nearest);
  }
}

// ---------------------------------------------------------------------------------------------- a path of keyframes

/** Unit quaternion (wxyz) of a rotation whose columns are given. */
function quaternionOf([a, b, c]) {
  const candidates = [
    [1 + a[0] + b[1] + c[2], b[2] - c[1], c[0] - a[2], a[1] - b[0]],
    [b[2] - c[1], 1 + a[0] - b[1] - c[2], a[1] + b[0], a[2] + c[0]],
    [c[0] - a[2], a[1] + b[0], 1 - a[0] + b[1] - c[2], b[2] + c[1]],
    [a[1] - b[0], a[2] + c[0], b[2] + c[1], 1 - a[0] - b[1] + c[2]],
  ];
  const best = candidates.reduce((x, y) => (Math.hypot(...y) > Math.hypot(...x) ? y : x));
  return best.map((x) => x / Math.hypot(...best));
}

/** Rows of the rotation of a quaternion (wxyz, any norm). */
function rotationOf(quaternion) {
  const norm = Math.hypot(...quaternion), [w, x, y, z] = quaternion.map((v) => v / norm);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** nerfstudio's camera path, a frame for each of its pictures: Catmull-Rom splines through the keyframes. */
function cameraPath(keyframes, width, height, fps = 24, secondsEach = 2) {
  const points = keyframes.map(({ camera_to_world: m, fov, aspect }) => {
    const quaternion = quaternionOf([[m[0], m[4], m[8]], [m[1], m[5], m[9]], [m[2], m[6], m[10]]]);
    return [m[3], m[7], m[11], ...quaternion, fov, aspect];
  });
  for (let k = 1; k < points.length; k++) {
    // Of both quaternions of a rotation, that on the side of the one before.
    if ([3, 4, 5, 6].reduce((sum, i) => sum + points[k][i] * points[k - 1][i], 0) < 0) {
      for (const i of [3, 4, 5, 6]) points[k][i] *= -1;
    }
  }
  const last = points.length - 1, frames = last * fps * secondsEach;
  const path = Array.from({ length: frames + 1 }, (_, frame) => {
    const k = Math.min(Math.floor(frame / (fps * secondsEach)), Math.max(last - 1, 0));
    const t = frame / (fps * secondsEach) - k;
    const [a, b, c, d] = [k - 1, k, k + 1, k + 2].map((i) => points[Math.min(Math.max(i, 0), last)]);
    const values = b.map((_, i) => {
      const bend = 2 * a[i] - 5 * b[i] + 4 * c[i] - d[i], twist = 3 * b[i] - a[i] - 3 * c[i] + d[i];
      return b[i] + 0.5 * t * (c[i] - a[i] + t * (bend + t * twist));
    });
    const rows = rotationOf(values.slice(3, 7)).map((row, i) => [...row, values[i]]);
    return { camera_to_world: [...rows.flat(), 0, 0, 0, 1], fov: values[7], aspect: values[8] };
  });
  return {
    camera_type: "perspective",
    render_height: height,
    render_width: width,
    fps,
    seconds: path.length / fps,
    camera_path: path,
  };
}

// ---------------------------------------------------------------------------------------------- the page

const element = (id) => document.getElementById(id);

function say(text) {
  element("message").textContent = text;
  element("message").hidden = !text;
}

/** Let the browser show what was said. */
const shown = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));

function bytesOf(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** Where the scene comes from if it is not in the page: see served.js. */
const server = window.nsvqServer;

/** The decoded scene and the engine that sorts it; `version` is what the server calls it. */
async function load(version) {
  const engine = await startEngine(element("decoder").textContent);
  try {
    const file = server ? await server.bytes() : bytesOf(element("file").textContent.trim()), bytes = file.length;
    // A newer scene takes the place of the one that is shown.
    if (!element("facts").textContent) say(`Decoding ${(bytes / 1e6).toFixed(2)} MB…`);
    await shown();
    const splats = await engine.decode(file.buffer);
    const { iteration, of, phase, psnr } = splats.header.config?.live ?? {};
    const facts = [`${splats.count.toLocaleString("en")} splats`, `${(bytes / 1e6).toFixed(2)} MB`];
    if (iteration) facts.push(`iteration ${iteration} of ${of}`, phase);
    if (psnr) facts.push(`test PSNR ${psnr} dB`);
    if (version.startsWith("scene.nsvq")) facts.push("the run has ended");
    element("facts").textContent = facts.join(" · ");
    return { engine, splats };
  } catch (error) {
    engine.end();
    if (server) throw new Error(`The scene cannot be shown: ${error.message}`);
    throw new Error(`The scene in this page is damaged: ${error.message}. Download or write the page again.`);
  }
}

/** Depth of what is in front at a place of the canvas: a low quantile of the splats around it, then of all. */
function depthAt({ count, means, opacities }, { position, axes, near }, { fx, fy, cx, cy }, x, y, around) {
  for (const radius of [around, Infinity]) {
    const depths = [];
    for (let i = 0; i < count; i++) {
      if (opacities[i] < 0.3) continue;
      const d = [means[3 * i] - position[0], means[3 * i + 1] - position[1], means[3 * i + 2] - position[2]];
      const z = dot(axes[2], d);
      if (!(z > near)) continue;
      const dx = (fx * dot(axes[0], d)) / z + cx - x, dy = (fy * dot(axes[1], d)) / z + cy - y;
      if (Math.hypot(dx, dy) < radius) depths.push(z);
    }
    if (depths.length > 4) return depths.sort((a, b) => a - b)[depths.length >> 2];
  }
  return 5 * near;
}

async function main() {
  const scene = JSON.parse(element("scene").textContent);
  if (typeof WebGL2RenderingContext === "undefined") {
    throw new Error("This browser has no WebGL 2, which this page needs. Update it, or try another one.");
  }
  let version = server?.seconds ? await server.newVersion("", say) : "";
  let { engine, splats } = await load(version);
  say("Sending splats to the GPU…");
  await shown();
  const canvas = element("canvas"), view = new ViewPoint(scene.up, scene.near);
  let renderer = new Renderer(canvas, splats);
  const own = splats.header.config?.background === "white" ? [1, 1, 1] : scene.background;
  const backgrounds = [own, [0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]];
  const keys = new Set(), keyframes = [], waiting = [];
  let background = 0, current = scene.start, scheduled = false, sorting = false, sorted = null, last = 0, touched = 0, share = 1;
  let portion = 1, sortedPortion = 1, swaying, swayed = 0, ratio = 0;

  // ---- frames, only when something changed

  const schedule = () => {
    if (!scheduled) {
      scheduled = true;
      requestAnimationFrame(frame);
    }
  };
  const moved = () => {
    touched = performance.now();
    schedule();
  };
  const draw = (resolution) => {
    const lens = view.lens(canvas.width, canvas.height);
    renderer.draw({ ...view, ...lens }, backgrounds[background], resolution);
  };

  function frame(now) {
    scheduled = false;
    if (devicePixelRatio !== ratio) resize(); // on another monitor
    const elapsed = last && now - last;
    if (keys.size) fly(Math.min(elapsed, 200) / 1000);
    if (swaying) sway(Math.min(elapsed, 200) / 1000);
    const moving = now - touched < 250;
    // A slow device shows fewer pixels while the view moves, then fewer splats, and takes up more in the other order.
    if (elapsed > 60) {
      if (share === 0.3) portion = Math.max(0.1, portion * Math.max(0.5, 40 / elapsed));
      share = Math.max(0.3, share * Math.max(0.5, Math.sqrt(40 / elapsed)));
    } else if (elapsed && portion < 1) portion = Math.min(1, portion * 1.02);
    else if (elapsed) share = Math.min(1, share * 1.02);
    last = moving ? now : 0;
    const direction = view.axes[2];
    const stale = !sorted || sorted.some((x, k) => x !== direction[k]) || (!moving && sortedPortion < 1);
    if (stale && !sorting) sort(direction, moving ? portion : 1);
    if (sorted) draw(moving ? share : 1);
    if (moving) schedule();
    else if (!stale) waiting.splice(0).forEach((resolve) => resolve());
  }

  function sort(direction, part) {
    const asked = engine;
    sorting = true;
    engine.sort(direction, part).then((order) => {
      if (asked !== engine) return; // the scene is another one now
      sorting = false;
      sorted = direction;
      sortedPortion = part;
      renderer.setOrder(order);
      schedule();
    }, fail);
  }

  /** Show each new version of a scene that trains, from where the viewer is. */
  async function watch() {
    for (;;) {
      version = await server.newVersion(version, say);
      try {
        const next = await load(version);
        renderer.release();
        engine.end();
        ({ engine, splats } = next);
        renderer = new Renderer(canvas, splats);
        sorting = false;
        sorted = null;
        say("");
        schedule();
      } catch (error) {
        say(error.message);
        version = ""; // to be asked for again
        await new Promise((resolve) => setTimeout(resolve, 1000 * server.seconds));
      }
    }
  }

  function resize() {
    const coarse = matchMedia("(pointer: coarse)").matches;
    ratio = devicePixelRatio;
    const finest = Math.min(ratio || 1, coarse ? 1.5 : 2);
    const sides = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * finest)));
    if (sides[0] === canvas.width && sides[1] === canvas.height) return;
    [canvas.width, canvas.height] = sides; // this also clears it
    schedule();
  }

  /** A promise that is kept when the present view has been drawn, sorted and at full resolution. */
  const settled = () =>
    new Promise((resolve) => {
      waiting.push(resolve);
      schedule();
    });

  // ---- a slow orbit to and fro, so that nothing comes into view that no photo has seen, until somebody takes over

  const rest = () => (swaying = false);
  for (const name of ["pointerdown", "wheel", "keydown", "hashchange", "visibilitychange"]) addEventListener(name, rest, true);

  function sway(seconds) {
    swayed += seconds;
    view.orbit(0.1 * seconds * Math.cos(swayed / 3.5), 0);
    touched = performance.now();
    if (share < 0.45) rest(); // the device is too slow
  }
  function beginSway() {
    if (swaying === undefined && !document.hidden) {
      swaying = true;
      moved();
    }
  }

  // ---- cameras

  /** Turn about what is in front at a place of the window, css pixels. */
  function focus(x, y) {
    const { clientWidth: width, clientHeight: height } = canvas;
    view.distance = depthAt(splats, view, view.lens(width, height), x, y, 0.06 * Math.min(width, height));
    view.nearest = 0.05 * view.distance;
  }
  function place(camera) {
    view.set(camera);
    focus(canvas.clientWidth / 2, canvas.clientHeight / 2);
    schedule();
  }
  function show(index) {
    current = (index + scene.cameras.length) % scene.cameras.length;
    element("cameras").value = current;
    place(scene.cameras[current]);
  }
  /** Go to the camera that the address names; returns what to say about it. */
  function follow() {
    const name = new URLSearchParams(location.hash.slice(1).replaceAll("+", "%2B")).get("camera");
    const index = name === null ? current : scene.cameras.findIndex((camera) => camera.name === name);
    show(Math.max(index, 0));
    return index < 0 ? `There is no camera ${name} here; this is the first one.` : "";
  }

  // ---- keyframes

  function listed() {
    element("keyframe").textContent = keyframes.length ? `+ Keyframe (${keyframes.length})` : "+ Keyframe";
    element("undo").hidden = element("download").hidden = !keyframes.length;
  }
  function addKeyframe() {
    const { camera_to_world, fy, width, height } = view.camera(canvas.width, canvas.height);
    const fov = (2 * Math.atan(height / 2 / fy) * 180) / Math.PI;
    keyframes.push({ camera_to_world, fov, aspect: width / height });
    listed();
  }
  function undoKeyframe() {
    keyframes.pop();
    listed();
  }
  // Video encoders want even sizes.
  const path = () => cameraPath(keyframes, canvas.width & ~1, canvas.height & ~1);
  function download() {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([JSON.stringify(path(), null, 1)], { type: "application/json" }));
    link.download = "camera_path.json";
    link.click();
    setTimeout(URL.revokeObjectURL, 60000, link.href);
  }

  /** HTML that shows this page in another one, said and, where the browser allows it, copied. */
  function embed() {
    const src = location.protocol === "file:" ? location.pathname.split("/").pop() : location.href;
    const frame = Object.assign(document.createElement("iframe"), { src, title: document.title, width: 800, height: 500 });
    frame.style = "border: 0";
    const html = frame.outerHTML;
    say(html);
    navigator.clipboard?.writeText(html).then(() => say(`Copied: ${html}`), () => {});
  }

  // ---- hands

  const changeBackground = () => {
    background = (background + 1) % backgrounds.length;
    schedule();
  };
  const actions = {
    previous: () => show(current - 1),
    next: () => show(current + 1),
    reset: () => show(current),
    background: changeBackground,
    keyframe: addKeyframe,
    undo: undoKeyframe,
    download,
    embed,
  };
  for (const [id, action] of Object.entries(actions)) {
    element(id).addEventListener("click", (event) => {
      action();
      if (event.detail) canvas.focus(); // not for a key, which may be pressed again
    });
  }
  const commands = { f: "next", F: "previous", r: "reset", b: "background", k: "keyframe", K: "undo" };
  const flight = {
    w: [2, 1], s: [2, -1], d: [0, 1], a: [0, -1], e: [1, -1], q: [1, 1],
    arrowleft: [3, 1], arrowright: [3, -1], arrowup: [4, -1], arrowdown: [4, 1],
  };

  function fly(seconds) {
    const steps = [0, 0, 0, 0, 0];
    for (const key of keys) steps[flight[key][0]] += flight[key][1] * seconds;
    view.move(...steps.slice(0, 3).map((step) => 0.6 * view.distance * step));
    if (steps[3] || steps[4]) view.orbit(steps[3], steps[4]);
    touched = performance.now();
  }

  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target === element("cameras")) return;
    const name = event.key.toLowerCase(), pressed = event.shiftKey ? name.toUpperCase() : name; // whatever Caps Lock says
    if (name in flight) {
      keys.add(name);
      if (!event.repeat) fly(1 / 20); // a slow device may draw nothing before the key is released
      moved();
    } else if (event.repeat) return;
    else if (pressed in commands) actions[commands[pressed]]();
    else if (name === "escape") say("");
    else if (name === "h") document.body.classList.toggle("bare");
    else return;
    event.preventDefault();
  });
  addEventListener("keyup", (event) => keys.delete(event.key.toLowerCase()));
  addEventListener("blur", () => keys.clear());

  const pointers = new Map();
  /** Middle of the fingers, and their distance from it. */
  const grip = () => {
    const at = [...pointers.values()], x = at.reduce((s, p) => s + p.x, 0) / at.length;
    const y = at.reduce((s, p) => s + p.y, 0) / at.length;
    return { x, y, spread: Math.hypot(at[0].x - x, at[0].y - y) };
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = grip();
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const after = grip(), dx = after.x - before.x, dy = after.y - before.y;
    if (pointers.size > 1 || event.shiftKey || event.buttons & 6) {
      const { fx, fy } = view.lens(canvas.clientWidth, canvas.clientHeight);
      view.move((-dx * view.distance) / fx, (-dy * view.distance) / fy, 0);
      if (before.spread > 0 && after.spread > 0) view.zoom(before.spread / after.spread);
    } else view.orbit((-dx * 3.5) / canvas.clientHeight, (-dy * 3.5) / canvas.clientHeight);
    moved();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", (event) => focus(event.clientX, event.clientY));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : 1);
    view.zoom(Math.exp(Math.max(-0.5, Math.min(0.5, pixels * (event.ctrlKey ? 0.01 : 0.0015)))));
    moved();
  }, { passive: false });

  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault(); // or it would never come back
    say("The graphics device was taken away; reload the page if it does not come back.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    renderer = new Renderer(canvas, splats);
    sorted = null;
    say("");
    schedule();
  });
  element("cameras").replaceChildren(...scene.cameras.map(({ name }, index) => new Option(name, index)));
  let pointed = false; // the arrow keys choose, too, and go on choosing
  element("cameras").addEventListener("pointerdown", () => (pointed = true));
  element("cameras").addEventListener("change", (event) => {
    show(Number(event.target.value));
    if (pointed) canvas.focus();
    pointed = false;
  });
  addEventListener("hashchange", () => say(follow()));
  canvas.addEventListener("pointerdown", () => say(""));
  element("embed").hidden = server;
  addEventListener("beforeprint", () => sorted && draw(1)); // or Firefox prints a black canvas
  new ResizeObserver(() => {
    resize();
    if (!sorted) return;
    draw(share); // at once: browsers show the cleared canvas before the next frame
    schedule();
  }).observe(canvas);

  window.nsvqViewer = {
    /** The present camera, or, given one of the same form, that one: a promise kept when it is drawn. */
    camera(next) {
      rest();
      if (next === undefined) return view.camera(canvas.width, canvas.height);
      place(next);
      return settled();
    },
    /** The keyframes as nerfstudio's camera path. */
    path,
    /** What is shown now, drawn again, as a data URL of a PNG. */
    picture() {
      rest();
      draw(1);
      return canvas.toDataURL();
    },
  };
  resize();
  const remark = follow();
  await settled();
  say(remark);
  if (server?.seconds) watch();
  else if (!location.hash && !matchMedia("(prefers-reduced-motion: reduce)").matches) setTimeout(beginSway, 1000);
}

function fail(error) {
  say(error.message);
  throw error;
}

/** For automation: kept when the first sorted picture is drawn, broken if there will be none. */
window.nsvqReady = main().catch(fail);
