// What moves on the page of a run: sliders between photo and render, and the curve, drawn as wide as the page.
"use strict";

/** An element with these properties and children. */
const made = (tag, properties, ...children) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
};

for (const figure of document.querySelectorAll(".views figure")) {
  const [photo, render, error] = figure.querySelectorAll("img");
  const range = made("input", { type: "range", value: 50, ariaLabel: "photo or render" });
  const names = ["photo", "render"].map((name) => made("span", {}, name));
  const pair = made("div", { className: "pair" }, photo, render, ...names, range);
  figure.prepend(pair);
  figure.lastElementChild.append(made("details", {}, made("summary", {}, "error x 4"), error));
  const cut = (percent) => {
    range.value = percent;
    pair.style.setProperty("--cut", `${percent}%`);
  };
  const follow = (event) => {
    const box = pair.getBoundingClientRect();
    cut(Math.min(100, Math.max(0, (100 * (event.clientX - box.left)) / box.width)));
  };
  range.addEventListener("input", () => cut(range.value));
  pair.addEventListener("pointerdown", (event) => {
    pair.setPointerCapture(event.pointerId);
    follow(event);
  });
  pair.addEventListener("pointermove", (event) => event.buttons && follow(event));
  pair.addEventListener("dragstart", (event) => event.preventDefault());
}

/** Round numbers that enclose `low` and `high`, at most about `most`. */
function ticks(low, high, most) {
  const least = (high - low || 1) / most, power = 10 ** Math.floor(Math.log10(least));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= 0.999 * least);
  const [first, last] = [Math.floor(low / step), Math.max(Math.ceil(high / step), Math.floor(low / step) + 1)];
  return Array.from({ length: last - first + 1 }, (_, k) => (first + k) * step);
}

/** PSNR and splats over the iterations, the phases shaded and named; every number of text is in css pixels. */
function draw(curve, { history, phases }) {
  const scale = parseFloat(getComputedStyle(document.documentElement).fontSize) / 16, width = curve.clientWidth - 24 * scale;
  const known = history.filter(([, psnr]) => Number.isFinite(psnr));
  // A run of some minutes may have gone on for longer than was planned.
  const end = (phases.at(-1)[1] = Math.max(1, phases.at(-1)[1], history.at(-1)?.[0] ?? 0));
  const bands = phases.map(([name, to], k) => ({ name, from: k ? phases[k - 1][1] : 0, to })).filter(({ from, to }) => to > from);
  const [left, right, bottom] = [44, 48, 44].map((side) => side * scale), plot = width - left - right;
  const tight = bands.some(({ name, from, to }) => (plot * (to - from)) / end < 8 * scale * name.length);
  const top = (tight ? 64 : 46) * scale, height = Math.min(400, Math.max(190, 0.36 * width)) + top + bottom;
  const decibels = ticks(Math.min(...known.map((row) => row[1])), Math.max(...known.map((row) => row[1])), 6);
  const counts = ticks(0, Math.max(...history.map((row) => row[2])), 5);
  const x = (iteration) => left + (plot * iteration) / end;
  const on = (axis, value) => top + ((height - top - bottom) * (axis.at(-1) - value)) / (axis.at(-1) - axis[0]);
  const line = (rows, axis, k) => `M${rows.map((row) => [x(row[0]), on(axis, row[k])]).join("L")}`;
  const text = (kind, anchor, across, down, words) =>
    `<text class="${kind}" text-anchor="${anchor}" x="${across}" y="${down}">${words}</text>`;
  const short = new Intl.NumberFormat("en", { notation: "compact" }), full = new Intl.NumberFormat("en");
  const parts = bands.map(({ from, to }) => `<rect x="${x(from)}" y="${top}" width="${x(to) - x(from)}" height="${height - top - bottom}"/>`);
  bands.forEach(({ name, from, to }, k) => {
    parts.push(text("", "middle", x((from + to) / 2), top - (8 + (tight && k % 2 ? 17 : 0)) * scale, name));
  });
  parts.push(text("psnr value", "start", 0, 14 * scale, "test PSNR, dB"), text("splats value", "end", width, 14 * scale, "splats"));
  for (const value of decibels) {
    parts.push(`<path class="grid" d="M${left},${on(decibels, value)}h${plot}"/>`);
    parts.push(text("psnr", "end", left - 8, on(decibels, value) + 4, full.format(value)));
  }
  for (const value of counts) parts.push(text("splats", "start", left + plot + 8, on(counts, value) + 4, short.format(value)));
  for (const value of ticks(0, end, plot / 55 / scale).filter((value) => value <= end)) {
    parts.push(text("", "middle", x(value), height - bottom + 18 * scale, full.format(value)));
  }
  parts.push(text("", "middle", left + plot / 2, height - 6, "iteration"));
  parts.push(`<path class="splats" d="${line(history, counts, 2)}"/><path class="psnr" d="${line(known, decibels, 1)}"/>`);
  for (const [iteration, psnr, splats] of known) {
    const words = `iteration ${full.format(iteration)}: ${psnr.toFixed(2)} dB, ${full.format(splats)} splats`;
    parts.push(`<circle class="psnr" cx="${x(iteration)}" cy="${on(decibels, psnr)}" r="3.5"><title>${words}</title></circle>`);
  }
  curve.innerHTML = `<svg role="img" aria-label="PSNR and splats by iteration" viewBox="0 0 ${width} ${height}" width="${width}">${parts.join("")}</svg>`;
}

// A run that trains: not while somebody reads its settings.
if (document.head.querySelector("noscript")) setInterval(() => document.querySelector("details[open]") ?? location.reload(), 5000);

const curve = document.getElementById("curve");
if (curve) new ResizeObserver(() => draw(curve, trained)).observe(curve);
