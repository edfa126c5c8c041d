// A canvas with two axes, moved by pointer and wheel.

/** What a pointer does on a canvas: drag, pinch, wheel, double click; `on` says what comes of it. */
function gestures(canvas, on) {
  const pointers = new Map();
  let begun = null;
  let moved = 0;
  const released = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (begun !== null && moved > 4) on.select(begun, event.offsetX);
    else if (moved <= 4) on.hover(event.offsetX, event.offsetY);
    if (begun !== null) on.selecting(null);
    begun = null;
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    moved = 0;
    begun = pointers.size === 1 && on.selects?.(event) ? event.offsetX : null;
  });
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = [event.offsetX, event.offsetY];
    const before = pointers.get(event.pointerId);
    if (!before) {
      on.hover(x, y);
      return;
    }
    const [dx, dy] = [x - before[0], y - before[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    pointers.set(event.pointerId, [x, y]);
    const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      begun = null;
      const apart = (p) => Math.max(20, Math.hypot(p[0] - other[0], p[1] - other[1]));
      on.pan(dx / 2, dy / 2);
      on.zoom(apart(before) / apart([x, y]), (x + other[0]) / 2, (y + other[1]) / 2);
    } else if (begun !== null) on.selecting(begun, x);
    else on.pan(dx, dy);
  });
  canvas.addEventListener("pointerup", released);
  canvas.addEventListener("pointercancel", released);
  canvas.addEventListener("dblclick", () => on.reset());
  canvas.addEventListener(
    "wheel",
    (event) => {
      const unit = event.deltaMode ? 16 : 1;
      const sideways = Math.abs(event.deltaX) > Math.abs(event.deltaY);
      const done = sideways
        ? on.pan(-event.deltaX * unit, 0)
        : on.zoom((event.ctrlKey ? 1.01 : 1.0016) ** (event.deltaY * unit), event.offsetX, event.offsetY);
      if (done) event.preventDefault();
    },
    { passive: false },
  );
}

/** A canvas with two axes of its own, which pointer and wheel move. */
class Plane {
  constructor(view, title, equal) {
    this.view = view;
    this.equal = equal;
    this.canvas = element("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", title);
    this.controls = element("div", "chips");
    this.heading = element("h2", "", title);
    this.note = element("p", "note");
    this.root = element(
      "section",
      "panel plane",
      "",
      element("header", "", "", this.heading, this.controls),
      element("div", "plot", "", this.canvas),
      this.note,
    );
    this.box = null;
    gestures(this.canvas, {
      hover: () => {},
      pan: (dx, dy) => this.move(-dx / this.sx, dy / this.sy, 1, 0, 0),
      zoom: (factor, x, y) => this.move(0, 0, factor, x, y),
      reset: () => this.reset(),
    });
  }

  reset() {
    this.box = null;
    this.draw();
  }

  move(dx, dy, factor, x, y) {
    const [x0, x1, y0, y1] = this.box ?? this.home;
    const [u, v] = [this.x0 + (x - LEFT) / this.sx, this.y0 - (y - TOP - this.tall) / this.sy];
    this.box = [
      u + (x0 - u) * factor + dx,
      u + (x1 - u) * factor + dx,
      v + (y0 - v) * factor + dy,
      v + (y1 - v) * factor + dy,
    ];
    this.draw();
    return true;
  }

  get visible() {
    const box = this.canvas.getBoundingClientRect();
    return box.bottom > -100 && box.top < window.innerHeight + 100 && box.width > 0;
  }

  /** Axes, and the scales from values to pixels. */
  frame(labels) {
    const { ctx, width, height } = fitted(this.canvas);
    let [x0, x1, y0, y1] = this.box ?? this.home;
    const [wide, tall] = [width - LEFT - RIGHT, height - TOP - BOTTOM - 4];
    if (this.equal) {
      const per = Math.max((x1 - x0) / wide, (y1 - y0) / tall);
      [x0, x1] = [(x0 + x1 - per * wide) / 2, (x0 + x1 + per * wide) / 2];
      [y0, y1] = [(y0 + y1 - per * tall) / 2, (y0 + y1 + per * tall) / 2];
    }
    Object.assign(this, { x0, y0, sx: wide / (x1 - x0), sy: tall / (y1 - y0), tall, wide });
    const across = this.ticks(x0, x1, wide / 80);
    const up = this.ticks(y0, y1, tall / 40);
    ctx.strokeStyle = colour("grid");
    ctx.fillStyle = colour("soft");
    ctx.lineWidth = 1;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    const end = `${labels[0]}${across.more}`;
    const room = width - RIGHT - ctx.measureText(end).width - 14;
    across.values.forEach((value, i) => {
      const x = Math.round(this.px(value)) + 0.5;
      line(ctx, x, TOP, x, TOP + tall);
      if (x + ctx.measureText(across.words[i]).width / 2 < room) ctx.fillText(across.words[i], x, TOP + tall + 6);
    });
    ctx.textAlign = "right";
    ctx.fillText(end, width - RIGHT, TOP + tall + 6);
    ctx.textBaseline = "middle";
    up.values.forEach((value, i) => {
      const y = Math.round(this.py(value)) + 0.5;
      line(ctx, LEFT, y, LEFT + wide, y);
      ctx.fillText(up.words[i], LEFT - 6, y);
    });
    ctx.textAlign = "left";
    ctx.textBaseline = "top";
    ctx.fillText(`${labels[1]}${up.more}`, LEFT + 5, TOP + 3);
    ctx.save();
    ctx.beginPath();
    ctx.rect(LEFT, TOP, wide, tall);
    ctx.clip();
    return ctx;
  }

  ticks(low, high, room) {
    return ticks(low, high, room);
  }

  px(x) {
    return LEFT + (x - this.x0) * this.sx;
  }

  py(y) {
    return TOP + this.tall - (y - this.y0) * this.sy;
  }
}
