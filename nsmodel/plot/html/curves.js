// What of a column is drawn in a window of time.

const BREAK = 0,
  VERTEX = 1,
  BAR = 2,
  BOX = 3;

/** Items to draw, (kind, x, x of the end, low, high) each; grown as needed and used again. */
class Items {
  constructor() {
    this.values = new Float64Array(5 * 4096);
    this.count = 0;
  }

  add(kind, x, end, low, high) {
    if (5 * this.count + 5 > this.values.length) {
      const more = new Float64Array(2 * this.values.length);
      more.set(this.values);
      this.values = more;
    }
    this.values.set([kind, x, end, low, high], 5 * this.count++);
  }

  /** Widens a bar that stands in the same pixel, or adds one. */
  bar(x, low, high) {
    const at = 5 * (this.count - 1);
    const v = this.values;
    if (at >= 0 && v[at] === BAR && Math.floor(v[at + 1]) === Math.floor(x)) {
      if (low < v[at + 3]) v[at + 3] = low;
      if (high > v[at + 4]) v[at + 4] = high;
    } else this.add(BAR, x, x, low, high);
  }
}

/** Fills `items` with a column from t0 to t1 over `width` pixels: what falls into one pixel is one bar of its extremes. */
function trace(column, t0, t1, width, items) {
  const { T, n } = column.clock;
  const scale = width / (t1 - t0);
  const first = Math.max(0, entryAt(column.clock, t0) - 1);
  const last = Math.min(n, entryAt(column.clock, t1) + 3);
  const back = column.held && !column.boxes ? 1 : 0; // A row's value belongs to the step that ends there.
  const pixel = (k) => (T[k > back ? k - back : 0] - t0) * scale;
  items.count = 0;
  const visit = (level, k) => {
    const size = FAN ** level;
    const a = k * size;
    const b = Math.min(n, a + size);
    if (b <= first || a >= last) return;
    const low = column.low[level][k];
    const high = column.high[level][k];
    const xa = pixel(a);
    const xb = pixel(b);
    if (Math.floor(xa) === Math.floor(xb) || (level === 0 && xb - xa < 1)) {
      if (low === low) items.bar(xa, low, high);
      else if (xb > xa) items.add(BREAK, xa, xb, 0, 0);
    } else if (level > 0) {
      for (let i = 0; i < FAN && k * FAN + i < column.low[level - 1].length; i++) visit(level - 1, k * FAN + i);
    } else if (low !== low) items.add(BREAK, xa, xb, 0, 0);
    else if (column.boxes) items.add(BOX, xa, xb, low, high);
    else if (column.held) {
      items.add(VERTEX, xa, xa, column.begin ? column.begin[a] : low, low);
      items.add(VERTEX, xb, xb, column.row[a], low);
    } else items.add(VERTEX, xa, xa, low, low);
  };
  visit(column.low.length - 1, 0);
}

/** Least and largest finite value of items. */
function reach(items, range, positive) {
  const v = items.values;
  for (let i = 0; i < items.count; i++) {
    if (v[5 * i] === BREAK) continue;
    for (let j = 3; j < 5; j++) {
      const value = v[5 * i + j];
      if (!Number.isFinite(value) || (positive && value <= 0)) continue;
      if (value < range.low) range.low = value;
      if (value > range.high) range.high = value;
    }
  }
}

/** Draws items as a line; tall bars and what is several rows wide are filled. `place` is the pixel of a value. */
function drawLine(ctx, items, place, left) {
  const v = items.values;
  let down = false;
  let [lastX, lastTop, lastBottom, penX, penY] = [0, 0, 0, NaN, NaN];
  const to = (x0, y0, x, y) => {
    if (x0 !== penX || y0 !== penY) ctx.moveTo(x0, y0);
    ctx.lineTo(x, y);
    [penX, penY] = [x, y];
  };
  ctx.beginPath();
  for (let i = 0; i < items.count; i++) {
    const at = 5 * i;
    const kind = v[at];
    if (kind === BREAK) {
      down = false;
      continue;
    }
    const x = left + v[at + 1];
    const end = kind === BOX ? left + v[at + 2] : x;
    const one = place(v[at + 3]);
    const other = kind === VERTEX ? one : place(v[at + 4]);
    const top = Math.min(one, other);
    const bottom = Math.max(one, other);
    const apart = lastTop > bottom || lastBottom < top;
    if (down && (apart || kind !== BOX)) {
      const from = apart ? (lastTop > bottom ? lastTop : lastBottom) : Math.min(bottom, Math.max(top, penY || lastTop));
      const near = Math.min(bottom, Math.max(top, from));
      to(lastX, Math.min(lastBottom, Math.max(lastTop, near)), x, near);
    }
    if (kind === BOX) {
      ctx.globalAlpha = 0.7;
      ctx.fillRect(x, top - 0.75, end - x, bottom - top + 1.5);
      ctx.globalAlpha = 1;
    } else if (bottom - top > 3) ctx.fillRect(x - 0.65, top, 1.3, bottom - top);
    else if (bottom > top || !down) {
      const upwards = penX === x && penY === bottom;
      to(x, upwards ? bottom : top, x, upwards ? top : bottom + 0.01);
    }
    [lastX, lastTop, lastBottom] = [end, top, bottom];
    down = true;
  }
  ctx.stroke();
}

/** Draws items as dots, those of a pixel as one bar. */
function drawDots(ctx, items, place, left) {
  const v = items.values;
  for (let i = 0; i < items.count; i++) {
    const at = 5 * i;
    if (v[at] === BREAK || v[at + 2] < 0) continue;
    const a = place(v[at + 3]);
    const b = v[at] === VERTEX ? a : place(v[at + 4]);
    const wide = v[at] === BOX ? Math.max(2, v[at + 2] - v[at + 1]) : 2;
    ctx.fillRect(left + v[at + 1] - 1, Math.min(a, b) - 1, wide, Math.abs(a - b) + 2);
  }
}
