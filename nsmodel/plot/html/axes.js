// Canvases, colours, axes, and numbers as text.

const LEFT = 72,
  RIGHT = 10,
  TOP = 8,
  BOTTOM = 22;

const palette = new Map();

/** A colour of the style sheet; forgotten when the theme changes. */
function colour(name) {
  if (!palette.has(name))
    palette.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return palette.get(name);
}

/** A canvas of the size of its element, in pixels of the device. */
function fitted(canvas) {
  const ratio = Math.min(2, window.devicePixelRatio || 1);
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  ctx.font = "11px system-ui, sans-serif";
  ctx.lineJoin = "bevel";
  return { ctx, width, height };
}

function line(ctx, x0, y0, x1, y1) {
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
}

/** Ticks of an axis: values, their words, and what to add to all of them. */
function ticks(low, high, room) {
  const raw = (high - low) / Math.max(1, room);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((m) => m * power >= raw * 0.999);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) values.push(k * step);
  const largest = Math.max(Math.abs(low), Math.abs(high));
  let base = 0;
  if (largest > 2e5 * step && values.length) base = values[0];
  const size = Math.floor(Math.log10(Math.max(largest - Math.abs(base), step, 1e-300)));
  const exponent = size >= 4 || size < -2 ? 3 * Math.floor(size / 3) : 0;
  const digits = Math.max(0, Math.min(12, exponent - Math.floor(Math.log10(step * 1.001))));
  const words = values.map((value) => ((value - base) / 10 ** exponent).toFixed(digits).replace(/^-(0\.?0*)$/, "$1"));
  const times = exponent
    ? ` ×10${String(exponent).replace(/[-\d]/g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)])}`
    : "";
  return { values, words, more: times + (base ? ` + ${number(base, 12)}` : "") };
}

/** Ticks of a logarithmic axis between exponents a and b: exponents, and the words of the numbers. */
function decades(a, b, room) {
  const values = [];
  if (b - a < 1.5) {
    for (let k = Math.floor(a); k <= b; k++) for (const m of [1, 2, 3, 5]) values.push(k + Math.log10(m));
  } else {
    const step = Math.max(1, Math.ceil((b - a) / room));
    for (let k = Math.ceil(a - 1e-9); k <= b + 1e-9; k += step) values.push(k);
  }
  const inside = values.filter((value) => value >= a - 1e-9 && value <= b + 1e-9);
  const words = inside.map((value) =>
    Math.abs(value) < 4 ? String(number(10 ** value, 2)) : (10 ** value).toExponential(0).replace("e+", "e"),
  );
  return { values: inside, words, more: "" };
}

/** A number in so many digits, as short as it is. */
function number(value, digits = 6) {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "–" : value > 0 ? "inf" : "-inf";
  return String(Number(value.toPrecision(digits)));
}
