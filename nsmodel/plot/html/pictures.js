// Pictures in the plane: one column over another, and discs in a room.

const MANY = 20_000,
  BOXES = 1_000; // Points and boxes beyond which a path is painted pixel by pixel.
const HEAT = ["#FFFFE5", "#FFF7BC", "#FEE391", "#FEC44F", "#FE9929", "#EC7014", "#CC4C02", "#993404", "#662506"];

/** One column over another: the whole run pale, the window of time in colour. */
class Phase extends Plane {
  constructor(view, columns, chosen) {
    super(view, "Phase plane", false);
    this.columns = columns;
    this.chosen = chosen;
    const boxes = view.clock.width > 1 ? ` Each ${view.clock.width} rows are a box that holds them.` : "";
    this.note.textContent = `Whole run pale, the time shown in colour; ○ start, ■ end, ● cursor.${boxes}`;
    const choices = ["across", "up"].map((word, i) => {
      const select = element("select");
      select.setAttribute("aria-label", word);
      columns.forEach((column, k) => select.append(new Option(column.label, k, false, k === chosen[i])));
      select.addEventListener("change", () => {
        this.chosen[i] = Number(select.value);
        this.reset();
      });
      return element("label", "key", `${word} `, select);
    });
    this.controls.append(...choices);
  }

  get home() {
    return this.chosen.flatMap((k) => {
      const column = this.columns[k];
      const ends = [column.low.at(-1)[0], column.high.at(-1)[0]].map((v) => (Number.isFinite(v) ? v : 0));
      const middle = (ends[0] + ends[1]) / 2;
      const flat = ends[1] - ends[0] <= 1e-9 * Math.max(...ends.map(Math.abs));
      const half = flat ? 0.1 * Math.abs(middle) || 1 : 0.55 * (ends[1] - ends[0]);
      return [middle - half, middle + half];
    });
  }

  draw() {
    const [a, b] = this.chosen.map((k) => this.columns[k]);
    const { clock } = a;
    const ctx = this.frame([a.label, b.label]);
    const { t0, t1, t } = this.view;
    const first = entryAt(clock, t0);
    const last = Math.min(clock.n, entryAt(clock, t1) + 1);
    if (first > 0 || last < clock.n) this.layer(ctx, "pale", a, b, 0, clock.n);
    this.layer(ctx, "line-0", a, b, first, last);
    const known = (k) => Number.isFinite(a.low[0][k]) && Number.isFinite(b.low[0][k]);
    const dot = (k, paint) => known(k) && paint(this.px(a.row[k]), this.py(b.row[k]));
    let start = 0;
    while (start < clock.n - 1 && !known(start)) start++;
    ctx.strokeStyle = ctx.fillStyle = colour("ink");
    ctx.lineWidth = 1.5;
    const round = (x, y, radius) => {
      ctx.beginPath();
      ctx.arc(x, y, radius, 0, 7);
    };
    dot(start, (x, y) => (round(x, y, 4), ctx.stroke()));
    dot(clock.n - 1, (x, y) => ctx.fillRect(x - 3.5, y - 3.5, 7, 7));
    ctx.fillStyle = colour("alert");
    dot(entryAt(clock, t), (x, y) => (round(x, y, 5), ctx.fill()));
    ctx.restore();
  }

  /** Puts a path on the canvas; it is painted anew only where it is another. */
  layer(ctx, paint, a, b, from, to) {
    const ratio = ctx.canvas.width / ctx.canvas.clientWidth;
    const key = [this.chosen, from, to, this.x0, this.sx, this.y0, this.sy, ratio, colour(paint)].join();
    const kept = (this.layers ??= {});
    if (kept[paint]?.key !== key) {
      const image = new OffscreenCanvas(Math.ceil(this.wide * ratio), Math.ceil(this.tall * ratio));
      const own = image.getContext("2d");
      const place = { x0: this.x0, sx: this.sx * ratio, y0: this.y0 + this.tall / this.sy, sy: -this.sy * ratio };
      (to - from > (a.boxes ? BOXES : MANY) ? dotted : drawn)(own, place, a, b, from, to, colour(paint), ratio);
      kept[paint] = { key, image };
    }
    ctx.drawImage(kept[paint].image, LEFT, TOP, kept[paint].image.width / ratio, kept[paint].image.height / ratio);
  }
}

/** The entries from..to as a line, or as the boxes that hold their rows. */
function drawn(ctx, { x0, sx, y0, sy }, a, b, from, to, paint, ratio) {
  ctx.strokeStyle = ctx.fillStyle = paint;
  ctx.lineWidth = 1.3 * ratio;
  ctx.beginPath();
  let down = false;
  for (let k = from; k < to; k++) {
    const [x, y] = [(a.row[k] - x0) * sx, (b.row[k] - y0) * sy];
    if (!Number.isFinite(x + y)) down = false;
    else if (a.boxes) {
      const [end, top] = [(a.high[0][k] - x0) * sx, (b.high[0][k] - y0) * sy];
      ctx.rect(x - 0.6, top - 0.6, end - x + 1.2, y - top + 1.2);
    } else {
      if (down) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
      down = true;
    }
  }
  if (a.boxes) ctx.fill();
  else ctx.stroke();
}

/** The same for many entries, pixel by pixel. */
function dotted(ctx, { x0, sx, y0, sy }, a, b, from, to, paint) {
  const { width, height } = ctx.canvas;
  const image = new ImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  const [red, green, blue] = [1, 3, 5].map((i) => Number.parseInt(paint.slice(i, i + 2), 16));
  const value = ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  let [lastX, lastY] = [NaN, NaN];
  const [across, up, farA, farB] = [a.row, b.row, a.high[0], b.high[0]];
  for (let k = from; k < to; k++) {
    const x = Math.round((across[k] - x0) * sx);
    const y = Math.round((up[k] - y0) * sy);
    if (a.boxes) {
      const end = Math.min(width - 1, Math.round((farA[k] - x0) * sx));
      const bottom = Math.min(height - 1, y);
      for (let v = Math.max(0, Math.round((farB[k] - y0) * sy)); v <= bottom; v++) {
        for (let u = Math.max(0, x); u <= end; u++) pixels[v * width + u] = value;
      }
      continue;
    }
    const steps = Math.min(4000, Math.max(Math.abs(x - lastX), Math.abs(y - lastY), 1)) || 1;
    for (let i = 1; i <= steps; i++) {
      const u = i === steps ? x : Math.round(lastX + ((x - lastX) * i) / steps);
      const v = i === steps ? y : Math.round(lastY + ((y - lastY) * i) / steps);
      if (u >= 0 && u < width && v >= 0 && v < height) pixels[v * width + u] = value;
    }
    [lastX, lastY] = [x, y];
  }
  ctx.putImageData(image, 0, 0);
}

/** Discs, walls and exits at the time of the cursor; discs in the colour of the pressure on them. */
class Configuration extends Plane {
  constructor(view, data, arrays) {
    super(view, "Configuration", true);
    Object.assign(this, { data, ...arrays });
    this.home = data.window;
    this.frames = data.rows.length;
    this.labels = [withUnit("x", data.unit), withUnit("y", data.unit)];
    const words =
      data.rows.length < data.of ? [`${data.rows.length} of ${data.of} rows are drawn here, evenly spread.`] : [];
    if (this.pressure) {
      const unit = data.pressure_unit ? ` ${data.pressure_unit}` : "";
      words.push(`Colour: sum of the reactions on a disc, 0 to ${number(data.top, 3)}${unit} and more.`);
      this.controls.append(
        element("span", "key", "0"),
        element("span", "heat"),
        element("span", "key", `${number(data.top, 3)}${unit}`),
      );
    }
    this.note.textContent = words.join(" ");
  }

  draw() {
    const next = firstFrom(this.times, this.view.t);
    const at = this.times[next] === this.view.t ? next : Math.max(0, next - 1);
    const ctx = this.frame(this.labels);
    const { radii, walls, exits, top } = this.data;
    this.trails(ctx, at);
    const rest = colour(this.pressure ? "rest" : "calm");
    const groups = new Map();
    for (let k = 0; k < radii.length; k++) {
      const pressed = this.pressure ? this.pressure[k * this.frames + at] : 0;
      const shade = pressed > 0 ? HEAT[Math.min(8, Math.round((8 * pressed) / top))] : rest;
      if (!groups.has(shade)) groups.set(shade, []);
      groups.get(shade).push(k);
    }
    const tiny = Math.max(...radii) * this.sx < 2; // Of so few pixels a disc is a square.
    ctx.strokeStyle = colour("disc");
    ctx.lineWidth = Math.min(1, 0.06 * Math.min(...radii) * this.sx);
    for (const [shade, members] of groups) {
      ctx.fillStyle = shade;
      ctx.beginPath();
      for (const k of members) {
        const x = this.px(this.places[2 * k * this.frames + at]);
        const y = this.py(this.places[(2 * k + 1) * this.frames + at]);
        const radius = radii[k] * this.sx;
        if (!Number.isFinite(x + y)) continue;
        if (tiny) ctx.rect(x - radius, y - radius, 2 * radius, 2 * radius);
        else {
          ctx.moveTo(x + radius, y);
          ctx.arc(x, y, radius, 0, 2 * Math.PI);
        }
      }
      ctx.fill();
      if (!tiny) ctx.stroke();
    }
    for (const [lines, paint, width, dash] of [
      [walls, "ink", 3, []],
      [exits, "line-2", 2.5, [6, 5]],
    ]) {
      ctx.strokeStyle = colour(paint);
      ctx.lineWidth = width;
      ctx.setLineDash(dash);
      for (const [x0, y0, x1, y1] of lines) line(ctx, this.px(x0), this.py(y0), this.px(x1), this.py(y1));
    }
    ctx.restore();
    ctx.setLineDash([]);
  }

  /** The ways of few discs so far. */
  trails(ctx, at) {
    const count = this.data.radii.length;
    if (count > 200) return;
    const every = Math.max(1, Math.ceil((at * count) / 20_000));
    ctx.strokeStyle = colour("pale");
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (let k = 0; k < count; k++) {
      let down = false;
      for (let i = at % every; i <= at; i += every) {
        const x = this.px(this.places[2 * k * this.frames + i]);
        const y = this.py(this.places[(2 * k + 1) * this.frames + i]);
        const there = Number.isFinite(x + y);
        if (there && down) ctx.lineTo(x, y);
        else if (there) ctx.moveTo(x, y);
        down = there;
      }
    }
    ctx.stroke();
  }
}

/** Where a state may not be at the time of the cursor, the way so far, and where it is. */
class Forbidden extends Plane {
  constructor(view, data, arrays, columns, labels) {
    super(view, "Configuration", columns.length === 2);
    Object.assign(this, { data, ...arrays, columns, labels });
    this.home = data.window;
    this.note.textContent = `Shaded: where some constraint is negative. ● cursor, line: the way so far. ${data.note}`;
    this.image = new OffscreenCanvas(data.size, data.size);
  }

  draw() {
    const { clock } = this.columns[0];
    const { t } = this.view;
    const next = firstFrom(this.times, t);
    const at = Math.min(this.times.length - 1, this.times[next] === t ? next : Math.max(0, next - 1));
    const ctx = this.frame(this.labels);
    this.shade(at);
    const [x0, x1, y0, y1] = this.data.window;
    // Points of the grid are the middles of the image's pixels.
    const [u, v] = [(x1 - x0) / (this.data.size - 1), (y1 - y0) / (this.data.size - 1)];
    const [wide, tall] = [u * this.data.size * this.sx, v * this.data.size * this.sy];
    ctx.drawImage(this.image, this.px(x0 - u / 2), this.py(y1 + v / 2), wide, tall);
    const row = entryAt(clock, t);
    const [across, up] =
      this.columns.length === 2 ? this.columns.map((column) => column.row) : [clock.T, this.columns[0].row];
    ctx.strokeStyle = colour("line-0");
    ctx.fillStyle = colour("alert");
    ctx.lineWidth = 1.4;
    ctx.beginPath();
    const every = Math.max(1, Math.ceil(row / 20_000));
    for (let k = row % every; k <= row; k += every) ctx.lineTo(this.px(across[k]), this.py(up[k]));
    ctx.stroke();
    ctx.beginPath();
    ctx.arc(this.px(across[row]), this.py(up[row]), 5, 0, 7);
    ctx.fill();
    ctx.restore();
  }

  /** Paints the set at one of its times; rows of the grid go upwards. */
  shade(at) {
    const { size } = this.data;
    const key = `${at} ${colour("forbidden")}`;
    if (key === this.key) return;
    this.key = key;
    const own = this.image.getContext("2d");
    own.clearRect(0, 0, size, size);
    own.fillStyle = colour("forbidden");
    for (let y = 0; y < size; y++) {
      for (let x = 0; x < size; x++) if (this.inside[(at * size + y) * size + x]) own.fillRect(x, size - 1 - y, 1, 1);
    }
  }
}
