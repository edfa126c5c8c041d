// Panels over time: lines, dots on a logarithmic axis, and the bands of an index set.

const withUnit = (name, unit) => (unit ? `${name} [${unit}]` : name);

/** What all panels over time have: a heading, chips, a canvas, the line of the cursor, a note. */
class TimePanel {
  constructor(data, view) {
    this.data = data;
    this.view = view;
    this.open = data.open;
    this.title = withUnit(data.title, data.unit);
    this.chips = element("div", "chips");
    this.canvas = element("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${this.title} over time`);
    this.cursor = element("div", "cursor");
    this.plot = element("div", "plot", "", this.canvas, this.cursor);
    this.root = element(
      "section",
      "panel",
      "",
      element("header", "", "", element("h2", "", this.title), this.chips),
      this.plot,
    );
    if (data.note) this.root.append(element("p", "note", data.note));
    this.root.hidden = !this.open;
  }

  get visible() {
    const box = this.canvas.getBoundingClientRect();
    return this.open && box.bottom > -100 && box.top < window.innerHeight + 100 && box.width > 0;
  }

  /** The grid, ticks and labels of time; the area inside. */
  frame(ctx, width, height) {
    const { t0, t1, timeLabel } = this.view;
    const area = { left: LEFT, top: TOP, width: width - LEFT - RIGHT, height: height - TOP - BOTTOM };
    const { values, words, more } = ticks(t0, t1, area.width / 90);
    ctx.strokeStyle = colour("grid");
    ctx.fillStyle = colour("soft");
    ctx.lineWidth = 1;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    const end = `${timeLabel}${more}`;
    const room = width - RIGHT - ctx.measureText(end).width - 14;
    values.forEach((value, i) => {
      const x = Math.round(area.left + ((value - t0) / (t1 - t0)) * area.width) + 0.5;
      line(ctx, x, area.top, x, area.top + area.height);
      if (x + ctx.measureText(words[i]).width / 2 < room) ctx.fillText(words[i], x, area.top + area.height + 5);
    });
    ctx.textAlign = "right";
    ctx.fillText(end, width - RIGHT, area.top + area.height + 5);
    this.marks(ctx, area);
    return area;
  }

  /** Events as lines where they are few, and stretches of steps as grounds. */
  marks(ctx, area) {
    const { t0, t1, events, stretches } = this.view;
    const place = (t) => area.left + ((t - t0) / (t1 - t0)) * area.width;
    ctx.fillStyle = colour("stretch");
    for (const [a, b] of stretches) {
      const x = Math.max(area.left, place(a));
      const end = Math.min(area.left + area.width, place(b));
      if (end > x) ctx.fillRect(x, area.top, end - x, area.height);
    }
    if (!events) return;
    const first = firstFrom(events.times, t0);
    const count = firstFrom(events.times, t1) - first;
    ctx.fillStyle = colour("event");
    let last = -1;
    for (let k = first; k < first + count; k++) {
      const x = Math.round(place(events.times[k]));
      if (x === last) continue;
      last = x;
      ctx.fillRect(x, area.top - 6, 1, 6);
      if (count <= area.width / 12) {
        ctx.globalAlpha = 0.25;
        ctx.fillRect(x, area.top, 1, area.height);
        ctx.globalAlpha = 1;
      }
    }
  }

  /** Moves the line of the cursor. */
  point() {
    const { t0, t1, t } = this.view;
    const share = (t - t0) / (t1 - t0);
    const inside = share >= 0 && share <= 1;
    this.cursor.hidden = !inside;
    if (inside)
      this.cursor.style.transform = `translateX(${LEFT + share * (this.canvas.clientWidth - LEFT - RIGHT)}px)`;
    this.tell();
  }
}

/** Columns as lines, or as dots on a logarithmic axis. */
class LinePanel extends TimePanel {
  constructor(data, view, columns) {
    super(data, view);
    this.columns = columns;
    this.items = columns.map(() => new Items());
    this.log = data.look === "log";
    const asked = columns.filter((column) => column.shown);
    for (const column of asked) column.shown = false;
    this.outputs = columns.map((column) => {
      const value = element("output");
      const swatch = element("span", "swatch");
      const chip = toggle("", asked.includes(column), (now) => {
        this.choose(column, now, swatch);
        view.redraw();
      });
      chip.append(swatch, element("span", "name", column.name), value);
      this.choose(column, asked.includes(column), swatch);
      if (column.missing) chip.title = `${column.missing} rows hold no number (NaN)`;
      this.chips.append(chip);
      return value;
    });
  }

  /** Shows a column in a colour that no other has, or hides it. */
  choose(column, now, swatch) {
    column.shown = false;
    const taken = this.columns.filter((other) => other.shown).map((other) => other.paint);
    const free = [0, 1, 2, 3, 4, 5, 6, 7].find((k) => !taken.includes(k));
    column.shown = now;
    column.paint = free ?? this.columns.indexOf(column) % 8;
    swatch.className = now ? `swatch c${column.paint}` : "swatch";
  }

  draw() {
    const { ctx, width, height } = fitted(this.canvas);
    const area = this.frame(ctx, width, height);
    const { t0, t1 } = this.view;
    const chosen = this.columns.map((column, k) => [column, k]).filter(([column]) => column.shown);
    const range = { low: Infinity, high: -Infinity };
    for (const [column, k] of chosen) {
      trace(column, t0, t1, area.width, this.items[k]);
      reach(this.items[k], range, this.log);
    }
    const level = this.data.level;
    if (level) reach({ values: [VERTEX, 0, 0, level[0], level[0]], count: 1 }, range, this.log);
    const place = this.axis(ctx, area, range);
    ctx.save();
    ctx.beginPath();
    ctx.rect(area.left, area.top - 2, area.width, area.height + 4);
    ctx.clip();
    if (level) {
      ctx.strokeStyle = colour("alert");
      line(ctx, area.left, place(level[0]), area.left + area.width, place(level[0]));
    }
    for (const [column, k] of chosen) {
      ctx.strokeStyle = ctx.fillStyle = colour(`line-${column.paint}`);
      ctx.lineWidth = 1.4;
      (this.log ? drawDots : drawLine)(ctx, this.items[k], place, area.left);
    }
    ctx.restore();
    if (level) {
      ctx.fillStyle = colour("alert");
      ctx.textAlign = "right";
      ctx.textBaseline = "bottom";
      ctx.fillText(level[1], area.left + area.width - 4, place(level[0]) - 2);
    }
  }

  /** The axis upwards; returns the pixel of a value. What is infinite, or 0 on a logarithmic axis, is at its end. */
  axis(ctx, area, range) {
    let { low, high } = range;
    if (low > high) [low, high] = this.log ? [1e-16, 1] : [-1, 1];
    if (this.log) [low, high] = [Math.min(low / 5, high / 1e3), high * 5];
    else {
      const least = Math.max(1e-9 * Math.max(Math.abs(low), Math.abs(high), this.largest), 1e-300);
      const middle = (low + high) / 2;
      const half = high - low > least ? 0.54 * (high - low) : Math.max(0.1 * Math.abs(middle), least);
      [low, high] = high === low && low === 0 && this.largest === 0 ? [-1, 1] : [middle - half, middle + half];
    }
    const [a, b] = this.log ? [Math.log10(low), Math.log10(high)] : [low, high];
    const bottom = area.top + area.height;
    const place = (value) => {
      const y = bottom - (((this.log ? Math.log10(value) : value) - a) / (b - a)) * area.height;
      return y < area.top ? area.top : y > bottom ? bottom : y;
    };
    const { values, words, more } = this.log ? decades(a, b, 4) : ticks(low, high, area.height / 32);
    ctx.strokeStyle = colour("grid");
    ctx.fillStyle = colour("soft");
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    values.forEach((value, i) => {
      const y = Math.round(place(this.log ? 10 ** value : value)) + 0.5;
      line(ctx, area.left, y, area.left + area.width, y);
      ctx.fillText(words[i], area.left - 6, y);
    });
    if (more) {
      ctx.textAlign = "left";
      ctx.textBaseline = "bottom";
      ctx.fillText(more.trim(), 2, area.top + area.height + 16);
    }
    this.range = [low, high];
    return place;
  }

  /** The largest size of the columns that are shown, over the whole run: what is far less is rounding. */
  get largest() {
    const sizes = this.columns.filter((column) => column.shown).flatMap((c) => [c.low.at(-1)[0], c.high.at(-1)[0]]);
    return Math.max(0, ...sizes.map(Math.abs).filter(Number.isFinite));
  }

  /** The values at the cursor; of several rows held as one from the least to the largest. */
  tell() {
    this.columns.forEach((column, k) => {
      const at = entryAt(column.clock, this.view.t);
      const [low, high] = [column.low[0][at], column.high[0][at]];
      const words = column.boxes && low !== high ? `${number(low, 4)} … ${number(high, 4)}` : number(column.row[at]);
      this.outputs[k].textContent = column.shown ? words : "";
    });
  }
}

/** The index set: a band a row of the law, a colour a state; where a pixel sees several the band is split. */
class BandPanel extends TimePanel {
  constructor(data, view, strips, clock) {
    super(data, view);
    this.strips = strips;
    this.clock = clock;
    const kinds = Object.entries(data.words);
    const seen = new Set();
    for (const [kind, words] of kinds) {
      for (const [, role, text] of words) {
        const label = kinds.length > 1 && kind !== "equality" ? `${kind}: ${text}` : text;
        if (!seen.has(label)) this.chips.append(element("span", "key", "", element("span", `swatch ${role}`), label));
        seen.add(label);
      }
    }
    this.chips.append(element("span", "key", "split: changes within a pixel"));
    this.plot.style.height = `${TOP + BOTTOM + Math.max(26, 18 * strips.length)}px`;
  }

  draw() {
    const { ctx, width, height } = fitted(this.canvas);
    const area = this.frame(ctx, width, height);
    const { t0, t1 } = this.view;
    const { T, n } = this.clock;
    const tall = area.height / this.strips.length;
    const scale = area.width / (t1 - t0);
    const back = this.clock.width === 1 ? 1 : 0; // A code belongs to the step that ends at its row.
    const x = (k) => Math.max(0, Math.min(area.width, (T[Math.max(0, k - back)] - t0) * scale));
    const first = entryAt(this.clock, t0);
    const last = Math.min(n, entryAt(this.clock, t1) + 2);
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    this.strips.forEach((strip, place) => {
      const top = area.top + place * tall + 1.5;
      const roles = this.data.words[strip.kind].map(([bit, role]) => [bit, colour(role)]);
      ctx.fillStyle = colour("soft");
      ctx.fillText(shortened(ctx, strip.name, LEFT - 10), area.left - 6, top + tall / 2 - 1.5);
      let from = 0;
      let bits = -1;
      const paint = (to) => {
        const own = roles.filter(([bit]) => bits & bit);
        own.forEach(([, fill], i) => {
          ctx.fillStyle = fill;
          ctx.fillRect(area.left + from, top + (i * (tall - 3)) / own.length, to - from, (tall - 3) / own.length);
        });
      };
      for (let k = first; k < last;) {
        const pixel = Math.floor(x(k));
        let next = k + 1;
        if (x(next) < pixel + 1)
          next = Math.max(next, Math.min(last, firstBeyond(this.clock, t0 + (pixel + 1) / scale) + 1));
        const now = seenOf(strip.levels, k, next);
        if (now !== bits) {
          if (bits > 0) paint(x(k));
          from = x(k);
          bits = now;
        }
        k = next;
      }
      if (bits > 0) paint(x(last));
    });
  }

  tell() {}
}

/** A name whose middle is cut out until it fits into a width. */
function shortened(ctx, name, width) {
  let kept = name;
  for (let n = name.length - 1; n > 1 && ctx.measureText(kept).width > width; n--) {
    kept = `${name.slice(0, Math.ceil(n / 2))}…${name.slice(name.length - Math.floor(n / 2))}`;
  }
  return kept;
}
