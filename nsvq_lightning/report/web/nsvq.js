// A reader of .nsvq files for web pages and node, as docs/nsvq_format.md specifies them. It needs nothing else.
//
//   const scene = nsvq.decode(await (await fetch("scene.nsvq")).arrayBuffer());
//
// An Error says what is wrong with a file; nothing is decoded then.
"use strict";

(function (root) {
  const MAGIC = [0x89, 0x4e, 0x53, 0x56, 0x51, 0x0d, 0x0a, 0x1a];
  const PREFIX = 32;
  const TWO32 = 2 ** 32;
  const LARGEST = 2 ** 52; // integers below it add up exactly in a double
  const SMALL = 2 ** 23; // the products of 45 pairs of integers below it add up to less than 2^52
  const FEW_SPLATS = 2 ** 18, FEW_ROWS = 2 ** 16; // what any file may hold; beyond, a splat takes two bytes or more, a row one
  const DIMS = { means: 3, opacities: 1, quats: 4, scales: 3, sh0: 3 };
  const ORDERS = {
    paper: ["means", "opacities", "quats", "scales", "sh0", "shN"],
    compact: ["opacities", "scales", "means", "quats", "sh0", "shN"],
  };

  function refuse(what) {
    throw new Error(`not a valid .nsvq file: ${what}; copy or download it again`);
  }

  // The frame

  // BLAKE2b (RFC 7693) with a digest of 16 bytes. Numbers of 64 bits are pairs of 32: low, high.
  const SEEDS = [
    0xf3bcc908, 0x6a09e667, 0x84caa73b, 0xbb67ae85, 0xfe94f82b, 0x3c6ef372, 0x5f1d36f1, 0xa54ff53a,
    0xade682d1, 0x510e527f, 0x2b3e6c1f, 0x9b05688c, 0xfb41bd6b, 0x1f83d9ab, 0x137e2179, 0x5be0cd19,
  ];
  const ROUNDS = [
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15], [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
    [11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4], [7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8],
    [9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13], [2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9],
    [12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11], [13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10],
    [6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5], [10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0],
  ];
  const MIXED = [[0, 4, 8, 12], [1, 5, 9, 13], [2, 6, 10, 14], [3, 7, 11, 15], [0, 5, 10, 15], [1, 6, 11, 12], [2, 7, 8, 13], [3, 4, 9, 14]];

  function add(v, a, low, high) {
    const sum = v[a] + low;
    v[a] = sum;
    v[a + 1] = v[a + 1] + high + (sum >= TWO32 ? 1 : 0);
  }

  function turn(v, a, b, right) { // v[a] = (v[a] xor v[b]) rotated right
    const low = v[a] ^ v[b], high = v[a + 1] ^ v[b + 1];
    if (right === 32) {
      v[a] = high;
      v[a + 1] = low;
    } else if (right === 63) {
      v[a] = (low << 1) | (high >>> 31);
      v[a + 1] = (high << 1) | (low >>> 31);
    } else {
      v[a] = (low >>> right) | (high << (32 - right));
      v[a + 1] = (high >>> right) | (low << (32 - right));
    }
  }

  function checksum(bytes) {
    const h = new Uint32Array(SEEDS), v = new Uint32Array(32), m = new Uint32Array(32), block = new Uint8Array(m.buffer);
    h[0] ^= 0x01010010;
    for (let at = 0; at === 0 || at < bytes.length; at += 128) {
      const end = Math.min(at + 128, bytes.length);
      block.fill(0);
      block.set(bytes.subarray(at, end));
      v.set(h);
      v.set(SEEDS, 16);
      v[24] ^= end;
      v[25] ^= end / TWO32;
      if (end === bytes.length) {
        v[28] = ~v[28];
        v[29] = ~v[29];
      }
      for (let round = 0; round < 12; round++) {
        const order = ROUNDS[round % 10];
        for (let i = 0; i < 8; i++) {
          const mixed = MIXED[i], a = 2 * mixed[0], b = 2 * mixed[1], c = 2 * mixed[2], d = 2 * mixed[3];
          const x = 2 * order[2 * i], y = 2 * order[2 * i + 1];
          add(v, a, v[b], v[b + 1]);
          add(v, a, m[x], m[x + 1]);
          turn(v, d, a, 32);
          add(v, c, v[d], v[d + 1]);
          turn(v, b, c, 24);
          add(v, a, v[b], v[b + 1]);
          add(v, a, m[y], m[y + 1]);
          turn(v, d, a, 16);
          add(v, c, v[d], v[d + 1]);
          turn(v, b, c, 63);
        }
      }
      for (let i = 0; i < 16; i++) h[i] ^= v[i] ^ v[i + 16];
    }
    return new Uint8Array(h.buffer, 0, 16);
  }

  function unframe(data) {
    if (MAGIC.some((byte, i) => data[i] !== byte)) refuse("it does not begin like one");
    if (data.length < PREFIX) refuse("it ends within its first 32 bytes");
    if (checksum(data.subarray(24)).some((byte, i) => data[8 + i] !== byte)) refuse("its checksum does not fit its content");
    const view = new DataView(data.buffer, data.byteOffset, data.length);
    const version = view.getUint32(24, true), length = view.getUint32(28, true);
    if (version < 2 || version > 4) throw new Error(`.nsvq version ${version} is not 2 to 4, those that this reader knows`);
    if (PREFIX + length > data.length) refuse("its header is longer than the file");
    let header;
    try {
      header = JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(data.subarray(PREFIX, PREFIX + length)));
    } catch (error) {
      refuse(`its header cannot be read (${error.message})`);
    }
    return { header, version, body: data.subarray(PREFIX + length) };
  }

  // The header

  const natural = value => Number.isSafeInteger(value) && value >= 0;
  const isTable = value => typeof value === "object" && value !== null && !Array.isArray(value);
  const same = (first, second) => first.length === second.length && first.every((value, i) => value === second[i]);
  const bitsOf = count => (count <= 1 ? 0 : count > 2 ** 31 ? 32 : 32 - Math.clz32(count - 1));

  function rowsOf(table, keys) {
    if (!Array.isArray(table)) refuse("its header lacks a table");
    return table.map(row => {
      if (!Array.isArray(row) || row.length !== keys.length) refuse("a row of its tables has the wrong length");
      return Object.fromEntries(keys.map((key, i) => [key, row[i]]));
    });
  }

  // Attribute entries and streams by name, both checked against everything that the counts ask for.
  function layout({ header, body, version }) {
    const { level, splats, sh_degree: degree, origin } = header || {};
    if (level !== "compact" && level !== "paper") refuse(`its level ${level} is unknown`);
    if (!natural(splats) || !natural(degree) || degree > 3) refuse("its header lacks the number of splats or the SH degree");
    if (!Array.isArray(origin) || origin.length !== 3 || !origin.every(Number.isFinite)) refuse("its origin is not three numbers");
    const { cameras = [] } = header;
    const fits = row => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite) && row[3] > 0;
    if (!Array.isArray(cameras) || cameras.length > 64 || !cameras.every(fits)) refuse("its cameras are not positions and focal lengths");
    if (!isTable(header.config) || !isTable(header.metrics)) refuse("its header lacks the settings or the metrics");
    if (!Object.values(header.metrics).every(value => value === null || typeof value === "number")) refuse("its metrics are not numbers");
    const attributes = rowsOf(header.attributes, ["name", "dim", "storage", "codes", "step"]);
    const table = {}, expected = [];
    if (!same(attributes.map(row => row.name), ORDERS[level])) refuse("its attributes are not those of its level");
    for (const entry of attributes) {
      const { name, dim, storage, codes, step } = entry;
      const wanted = name === "shN" ? 3 * ((degree + 1) ** 2 - 1) : DIMS[name];
      const codable = !(name in { means: 0, opacities: 0 }) && dim > 0;
      if (dim !== wanted || !natural(codes) || !Number.isFinite(step) || step < 0) refuse(`its entry of ${name} is not possible`);
      const stored = level === "paper" ? storage === "raw" || (storage === "codes" && codable)
        : name === "means" ? storage === "cells"
        : name === "opacities" ? storage === "levels"
        : storage === "steps" || (storage === "codes" && codable) || (storage === "components" && name === "shN" && dim > 0);
      const coded = storage === "codes" || storage === "levels" || storage === "components";
      const most = storage === "levels" ? 2 ** 20 : storage === "components" ? dim : TWO32;
      if (!stored || (coded ? codes < 1 || codes > most : codes !== 0)) refuse(`its entry of ${name} is not possible`);
      if ((level === "compact" && storage !== "levels") !== step > 0) refuse(`its step of ${name} is not possible`);
      let power = 1; // the largest one up to the step, of those that a basis may have
      for (let i = 0; i < 149 && power > step; i++) power /= 2;
      if (storage === "components" && step !== power) refuse(`its step of ${name} is not possible`);
      table[name] = entry;
      if (level === "compact" && name === "means") expected.push("means.grid:grid", "means:keys", "means.far:float32");
      else if (level === "compact" && storage === "codes") expected.push(`${name}.codebook:integers`, `${name}:paths`);
      else if (storage === "components") expected.push(`${name}.basis:integers`, `${name}:integers`);
      else if (level === "compact") expected.push(`${name}:${storage === "levels" ? "paths" : "integers"}`);
    }
    const entries = Object.values(table), coded = entries.filter(entry => entry.storage === "codes");
    if (level === "paper") {
      for (const entry of entries) if (entry.storage === "raw") expected.push(`${entry.name}:float32`);
      if (coded.length) expected.push("codes:bits");
      for (const entry of coded) expected.push(`${entry.name}.codebook:float32`);
    }
    const rows = rowsOf(header.streams, ["name", "length", "encoding"]), streams = {};
    if (!same(rows.map(row => `${row.name}:${row.encoding}`), expected)) refuse("its streams are not those of its attributes");
    let at = 0;
    for (const { name, length } of rows) {
      if (!natural(length) || at + length > body.length) refuse(`its stream ${name} is longer than the file`);
      streams[name] = body.subarray(at, (at += length));
    }
    if (at !== body.length) refuse("bytes follow its last stream");
    for (const { name, codes } of coded)
      if (level === "compact" && codes > Math.max(FEW_ROWS, streams[`${name}.codebook`].length)) refuse(`its codebook of ${name} is too large`);
    if (level === "compact" && splats > Math.max(FEW_SPLATS, body.length / 2)) refuse("it has too many splats for its length");
    return { level, splats, degree, origin, table, streams, version };
  }

  // The range decoder

  const RATES = Int32Array.from({ length: 127 }, (_, n) => Math.floor((1310720 + 10 * n + 16) / (20 * n + 32)));

  const CODE_HIGH = 0, CODE_LOW = 1, HIGH = 2, LOW = 3;

  class RangeDecoder {
    constructor(data, contexts, met = 0) {
      if (data.length % 4) refuse("the length of a stream is not a multiple of 4");
      this.words = new Uint32Array(data.slice().buffer);
      this.used = 2;
      // Code and width, unsigned numbers of 64 bits, as halves; in an array, since fields above 2^31 are slow.
      this.state = Uint32Array.of(this.words.length > 0 ? this.words[0] : 0, this.words.length > 1 ? this.words[1] : 0, ~0, ~0);
      this.chances = new Uint16Array(contexts).fill(32768);
      this.seen = new Uint8Array(contexts).fill(met);
    }

    refill() { // when the width is below 2^32
      const state = this.state;
      state[HIGH] = state[LOW];
      state[LOW] = 0;
      state[CODE_HIGH] = state[CODE_LOW];
      state[CODE_LOW] = this.used < this.words.length ? this.words[this.used] : 0;
      if (this.used++ > this.words.length) this.end(); // what would follow is worth no time
    }

    bit(context, quick = context) { // of one context, or by the mean of two
      const state = this.state, chance = (this.chances[context] + this.chances[quick]) >>> 1;
      const product = (((state[HIGH] << 16) | (state[LOW] >>> 16)) >>> 0) * chance; // below 2^48
      const low = product >>> 0, high = ((state[HIGH] >>> 16) * chance + Math.floor(product / TWO32)) >>> 0;
      const codeHigh = state[CODE_HIGH], codeLow = state[CODE_LOW];
      let one = 0;
      if (codeHigh < high || (codeHigh === high && codeLow < low)) {
        one = 1;
        state[HIGH] = high;
        state[LOW] = low;
      } else {
        state[CODE_HIGH] = codeHigh - high - (codeLow < low ? 1 : 0);
        state[CODE_LOW] = codeLow - low;
        state[HIGH] = state[HIGH] - high - (state[LOW] < low ? 1 : 0);
        state[LOW] = state[LOW] - low;
      }
      const target = 48 + 65440 * one;
      if (quick === context) this.learn(context, target, 126);
      else {
        this.learn(context, target, 60);
        this.learn(quick, target, 6);
      }
      if (state[HIGH] === 0) this.refill();
      return one;
    }

    learn(context, target, limit) {
      const chance = this.chances[context], seen = this.seen[context];
      this.chances[context] = chance + (((target - chance) * RATES[seen]) >> 16);
      if (seen < limit) this.seen[context] = seen + 1;
    }

    digit(bits) { // a number of 1 to 16 bits, without a model
      const state = this.state;
      state[LOW] = (state[LOW] >>> bits) | (state[HIGH] << (32 - bits));
      state[HIGH] >>>= bits;
      const widthHigh = state[HIGH], widthLow = state[LOW], codeHigh = state[CODE_HIGH], codeLow = state[CODE_LOW];
      const largest = (1 << bits) - 1;
      let digit = Math.min(Math.floor((codeHigh * TWO32 + codeLow) / (widthHigh * TWO32 + widthLow)), largest);
      for (;;) { // the quotient of rounded numbers may be one off
        const product = widthLow * digit, low = product >>> 0, high = widthHigh * digit + Math.floor(product / TWO32);
        if (high > codeHigh || (high === codeHigh && low > codeLow)) {
          digit--;
          continue;
        }
        const restHigh = codeHigh - high - (codeLow < low ? 1 : 0), restLow = (codeLow - low) >>> 0;
        if (digit < largest && (restHigh > widthHigh || (restHigh === widthHigh && restLow >= widthLow))) {
          digit++;
          continue;
        }
        state[CODE_HIGH] = restHigh;
        state[CODE_LOW] = restLow;
        if (widthHigh === 0) this.refill();
        return digit;
      }
    }

    plain(bits) { // a number of up to 52 bits, without a model
      let value = 0;
      for (; bits > 16; bits -= 16) value = value * 65536 + this.digit(16);
      return bits > 0 ? value * 2 ** bits + this.digit(bits) : value;
    }

    length(context) { // a number below 64
      let node = 1;
      for (let i = 0; i < 6; i++) node = 2 * node + this.bit(64 * context + node);
      return node - 64;
    }

    end() {
      if (this.used !== this.words.length + 1) refuse("a stream does not end with its last number");
    }
  }

  // The streams

  function leafOf(path, bits, count) { // of a path down the tree that halves [0, count) again and again
    let low = 0, high = count;
    for (let left = bits - 1; left >= 0; left--) {
      const right = (path >>> left) & 1;
      if (high - low > 1) {
        const cut = low + ((high - low + 1) >>> 1);
        if (right) low = cut;
        else high = cut;
      } else if (right) refuse("a code is beyond its codebook");
    }
    return low;
  }

  // Leaf of each row; neighbours [2 * rows] holds pairs of earlier rows, -1 for none. Decisions have two contexts, or one.
  function decodePaths(data, count, rows, neighbours, paired) {
    const bits = bitsOf(count), modelled = Math.min(bits, 16), whole = count === 2 ** bits, alone = 9 << modelled;
    const decoder = new RangeDecoder(data, paired ? 10 << modelled : alone, paired ? 2 : 0), paths = new Uint16Array(rows), leaves = new Uint32Array(rows);
    for (let row = 0; row < rows; row++) {
      const first = neighbours[2 * row], second = neighbours[2 * row + 1];
      let path = 0, one = first < 0 ? -1 : paths[first], two = second < 0 ? -1 : paths[second];
      for (let left = modelled - 1; left >= 0; left--) {
        // A neighbour whose path has led elsewhere says nothing any more.
        if (one >> (left + 1) !== path) one = -1;
        if (two >> (left + 1) !== path) two = -1;
        const saysOne = one < 0 ? 0 : 1 + ((one >> left) & 1), saysTwo = two < 0 ? 0 : 1 + ((two >> left) & 1);
        const node = (1 << (modelled - 1 - left)) + path, context = 9 * node + 3 * saysOne + saysTwo;
        path = 2 * path + decoder.bit(context, paired ? alone + node : context);
      }
      paths[row] = path;
      const full = path * 2 ** (bits - modelled) + decoder.plain(bits - modelled);
      leaves[row] = whole ? full : leafOf(full, bits, count);
    }
    decoder.end();
    return leaves;
  }

  // Calls take(row, column, integer) for each integer.
  function decodeIntegers(data, rows, columns, take) {
    if (data.length < columns) refuse("a stream of integers is too short");
    const decoder = new RangeDecoder(data.subarray(columns), 128 * columns), sums = new Float64Array(columns);
    for (let column = 0; column < columns; column++) if (data[column] > 3) refuse("a column of integers has an unknown mode");
    for (let row = 0; row < rows; row++) {
      let before = 0; // what the column before has
      for (let column = 0; column < columns; column++) {
        const length = decoder.length(column);
        let value = 0;
        if (length > 53) refuse("an integer is beyond 2^53");
        if (length > 0) {
          const negative = decoder.plain(1);
          value = 1;
          if (length > 1) {
            value = 2 + decoder.bit(64 * (columns + column) + length);
            value = value * 2 ** (length - 2) + decoder.plain(length - 2);
          }
          if (negative) value = -value;
        }
        if (data[column] & 1) value = sums[column] += value;
        if (data[column] & 2) value += before;
        before = value;
        if (Math.abs(value) >= LARGEST) refuse("an integer is beyond 2^52");
        take(row, column, value);
      }
    }
    decoder.end();
  }

  function everyThird(word) { // bits 0, 3, 6, ... 30 of 32, side by side
    word &= 0x49249249;
    word = (word ^ (word >>> 2)) & 0xc30c30c3;
    word = (word ^ (word >>> 4)) & 0x0f00f00f;
    word = (word ^ (word >>> 8)) & 0xff0000ff;
    return (word ^ (word >>> 16)) & 0xffff;
  }

  // Positions, and the points that near rows are found by, of the splats inside the grid.
  function decodeKeys(data, depths, base, step, means) {
    const count = depths.length, decoder = new RangeDecoder(data, 64 * 22 * 11), points = new Int32Array(3 * count);
    let high = 0, low = 0, before = 0; // the last key: 31 and 32 bits
    for (let row = 0; row < count; row++) {
      const depth = depths[row], shift = 63 - 3 * depth, length = decoder.length(11 * depth + Math.floor(before / 6));
      if (length > 3 * depth) refuse("a position is outside its grid");
      let stepHigh = 0, stepLow = length > 0 ? 1 : 0;
      for (let bits = length - 1; bits > 0; bits -= 16) {
        const now = Math.min(bits, 16);
        stepHigh = (stepHigh << now) | (stepLow >>> (32 - now));
        stepLow = ((stepLow << now) | decoder.digit(now)) >>> 0;
      }
      if (shift >= 32) { // the last key without its lower bits, and the step before them
        high = ((high >>> (shift - 32)) << (shift - 32)) + (stepLow << (shift - 32));
        low = 0;
      } else {
        const sum = ((low >>> shift) << shift >>> 0) + ((stepLow << shift) >>> 0);
        high += (shift ? (stepHigh << shift) | (stepLow >>> (32 - shift)) : stepHigh) + (sum >= TWO32 ? 1 : 0);
        low = sum >>> 0;
      }
      if (high < 0 || high >= 2 ** 31) refuse("a position is outside its grid");
      before = length > 0 ? length + shift : 0;
      const width = 2 ** (21 - depth);
      for (let axis = 0; axis < 3; axis++) {
        const below = everyThird(low >>> (2 - axis)), above = everyThird(high >>> ((3 - axis) % 3));
        const corner = axis === 0 ? (below & 0x3ff) | (above << 10) : below | (above << 11);
        means[3 * row + axis] = (corner + 0.5 * width + base[axis]) * step;
        points[3 * row + axis] = corner + (width >> 1);
      }
    }
    decoder.end();
    return points;
  }

  function rowsBefore(count) {
    const neighbours = new Int32Array(2 * count);
    for (let row = 0; row < count; row++) {
      neighbours[2 * row] = row - 1;
      neighbours[2 * row + 1] = Math.max(row - 2, -1);
    }
    return neighbours;
  }

  function nearRows(points, count) {
    const neighbours = rowsBefore(count);
    for (let row = 0; 3 * row < points.length; row++) {
      const x = points[3 * row], y = points[3 * row + 1], z = points[3 * row + 2];
      let first = -1, second = -1, nearest = Infinity, next = Infinity;
      for (let other = Math.max(0, row - 16); other < row; other++) {
        const dx = x - points[3 * other], dy = y - points[3 * other + 1], dz = z - points[3 * other + 2];
        const distance = dx * dx + dy * dy + dz * dz;
        if (distance < nearest) {
          next = nearest;
          second = first;
          nearest = distance;
          first = other;
        } else if (distance < next) {
          next = distance;
          second = other;
        }
      }
      neighbours[2 * row] = first;
      neighbours[2 * row + 1] = second;
    }
    return neighbours;
  }

  const LN2 = 0.6931471805599453;

  // Bits of each axis of a position, by what the splat's size and opacity are.
  function depthsOf(count, scaleSum, scaleStep, doublings, levels, levelCount) {
    const factor = scaleStep / 3 / LN2, logs = new Float64Array(levelCount), depths = new Uint8Array(count);
    for (let level = 0; level < levelCount; level++) {
      let mantissa = (level + 0.5) / levelCount, exponent = 0;
      for (; mantissa < 0.5; mantissa *= 2) exponent--;
      logs[level] = 2 * mantissa - 2 + exponent;
    }
    for (let row = 0; row < count; row++) {
      const x = scaleSum(row) * factor + doublings - 0.5 * logs[levels[row]];
      depths[row] = 21 - Math.min(Math.max(Math.floor(x), 0), 21);
    }
    return depths;
  }

  // The levels of a file

  const floats = data => new Float32Array(data.slice().buffer);

  function taken(codebook, dim, codes) { // rows of a codebook
    const values = new Float32Array(codes.length * dim);
    for (let row = 0, at = 0; row < codes.length; row++) {
      for (let from = codes[row] * dim, end = from + dim; from < end; ) values[at++] = codebook[from++];
    }
    return values;
  }

  // Whole multiples of the rows of a basis, added up: of each splat, one row at a time.
  function decodeComponents(basisData, data, rows, { dim, codes, step }) {
    const basis = new Int32Array(codes * dim), sums = new Float64Array(dim), values = new Float32Array(rows * dim);
    const small = value => Math.abs(value) < SMALL || refuse("a component is beyond 2^23");
    decodeIntegers(basisData, codes, dim, (row, column, value) => {
      small(value);
      basis[row * dim + column] = value;
    });
    decodeIntegers(data, rows, codes, (row, column, value) => {
      small(value);
      if (column === 0) sums.fill(0);
      if (value !== 0) for (let i = 0, at = column * dim; i < dim; i++) sums[i] += value * basis[at + i];
      if (column === codes - 1) for (let i = 0, at = row * dim; i < dim; i++) values[at + i] = sums[i] * step;
    });
    return values;
  }

  function decodeCompact({ splats, table, streams, version }) {
    const values = {}, leaves = {}, integers = {};
    if (streams["means.grid"].length !== 32) refuse("its grid is not 32 bytes");
    if (streams["means.far"].length % 12 || streams["means.far"].length > 12 * splats) refuse("its far positions have the wrong length");

    function decode(name, neighbours) {
      const { storage, dim, codes, step } = table[name];
      if (storage === "components") {
        values[name] = decodeComponents(streams[`${name}.basis`], streams[name], splats, table[name]);
        return;
      }
      const rows = storage === "codes" ? codes : storage === "steps" ? splats : 0, found = new Float32Array(rows * dim);
      const exact = name === "scales" ? (integers[name] = new Float64Array(rows * dim)) : null;
      if (storage !== "levels") {
        decodeIntegers(streams[storage === "codes" ? `${name}.codebook` : name], rows, dim, (row, column, value) => {
          found[row * dim + column] = value * step;
          if (exact) exact[row * dim + column] = value;
        });
      }
      if (storage !== "steps") leaves[name] = decodePaths(streams[name], codes, splats, neighbours, version > 3);
      if (storage !== "levels") values[name] = storage === "codes" ? taken(found, dim, leaves[name]) : found;
    }

    const before = rowsBefore(splats);
    for (const name of ["opacities", "scales"]) decode(name, before);
    const grid = new DataView(streams["means.grid"].slice().buffer), doublings = grid.getFloat64(24, true);
    const base = [0, 8, 16].map(at => Number(grid.getBigInt64(at, true))), far = floats(streams["means.far"]);
    if (!Number.isFinite(doublings)) refuse("its grid is not finite");
    const three = integers.scales, scaleCodes = leaves.scales, inside = splats - far.length / 3;
    const scaleSum = row => {
      const at = 3 * (scaleCodes ? scaleCodes[row] : row);
      return three[at] + three[at + 1] + three[at + 2];
    };
    const count = table.opacities.codes;
    const depths = depthsOf(inside, scaleSum, table.scales.step, doublings, leaves.opacities, count);
    values.means = new Float32Array(3 * splats);
    values.means.set(far, 3 * inside);
    const near = nearRows(decodeKeys(streams.means, depths, base, table.means.step, values.means), splats);
    for (const name of ["quats", "sh0", "shN"]) decode(name, near);
    const logits = Float32Array.from({ length: count }, (_, level) => {
      const share = (level + 0.5) / count;
      return Math.log(share) - Math.log1p(-share);
    });
    values.opacities = taken(logits, 1, leaves.opacities);
    return values;
  }

  function bitsAt(data, at, bits) { // a number of up to 32 bits, lowest first
    let value = 0;
    for (let done = 0; done < bits; ) {
      const now = Math.min(8 - ((at + done) & 7), bits - done);
      value += ((data[Math.floor((at + done) / 8)] >>> ((at + done) & 7)) & ((1 << now) - 1)) * 2 ** done;
      done += now;
    }
    return value;
  }

  function decodePaper({ splats, table, streams }) {
    const values = {}, coded = Object.values(table).filter(entry => entry.storage === "codes");
    const record = coded.reduce((sum, entry) => sum + bitsOf(entry.codes), 0);
    const expect = (name, length) => {
      if (streams[name].length !== length) refuse(`its stream ${name} has ${streams[name].length} bytes instead of ${length}`);
    };
    if (coded.length) expect("codes", Math.ceil((splats * record) / 8));
    for (const { name, storage, dim, codes } of Object.values(table))
      expect(storage === "raw" ? name : `${name}.codebook`, 4 * dim * (storage === "raw" ? splats : codes));
    let at = 0;
    for (const { name, storage, dim, codes } of Object.values(table)) {
      if (storage === "raw") {
        values[name] = floats(streams[name]);
        continue;
      }
      const bits = bitsOf(codes), rows = new Uint32Array(splats);
      for (let row = 0; row < splats; row++) {
        rows[row] = bitsAt(streams.codes, row * record + at, bits);
        if (rows[row] >= codes) refuse(`a code of ${name} is beyond its codebook`);
      }
      at += bits;
      values[name] = taken(floats(streams[`${name}.codebook`]), dim, rows);
    }
    return values;
  }

  /**
   * Decode a file.
   *
   * @param {ArrayBuffer|Uint8Array} file The bytes of a .nsvq file.
   * @returns {{count: number, shDegree: number, origin: number[], means: Float32Array, quats: Float32Array,
   *   scales: Float32Array, opacities: Float32Array, sh0: Float32Array, shN: Float32Array, header: object}}
   *   count splats, each attribute row by row: means [3] relative to origin, quats [4] as w, x, y, z of any length,
   *   scales [3] as natural logarithms, opacities [1] before the sigmoid, sh0 [3], shN [((shDegree + 1)^2 - 1) * 3].
   */
  function decode(file) {
    const data = ArrayBuffer.isView(file) ? new Uint8Array(file.buffer, file.byteOffset, file.byteLength) : new Uint8Array(file);
    const framed = unframe(data), plan = layout(framed);
    const values = plan.level === "compact" ? decodeCompact(plan) : decodePaper(plan);
    return { count: plan.splats, shDegree: plan.degree, origin: plan.origin, ...values, header: framed.header };
  }

  root.nsvq = { decode };
  if (typeof module !== "undefined") module.exports = root.nsvq;
})(globalThis);
