// The page of a run: built from its data, moved by pointer, keys and slider.

const LASTS = 12; // Seconds in which the time shown is played.
const DEEPEST = 1e-9; // Of the run, the shortest time shown.

class View {
  constructor(data) {
    this.data = data;
    this.timeLabel = withUnit("t", data.time.unit);
    this.stretches = data.stretches;
    this.panels = [];
    this.planes = [];
    this.playing = false;
    this.frames = [];
    this.waiting = { window: false, cursor: false };
  }

  /** Unpacks all columns and builds the page. */
  async build() {
    const { data } = this;
    this.clocks = await Promise.all(data.clocks.map(clockOf));
    this.clock = this.clocks[0];
    const { T, n } = this.clock;
    this.span = [T[0], T[n] > T[0] ? T[n] : T[0] + 1];
    [this.t0, this.t1] = this.span;
    this.t = T[0];
    this.events = data.events && { ...data.events, times: await unpack(data.events.times) };
    this.panels = await Promise.all(
      data.panels.map(async (panel) => {
        const clock = this.clocks[panel.clock];
        if (panel.look === "bands")
          return new BandPanel(panel, this, await Promise.all(panel.bands.map(stripOf)), clock);
        return new LinePanel(
          panel,
          this,
          await Promise.all(panel.columns.map((column) => columnOf(column, panel.look, clock))),
        );
      }),
    );
    if (data.scene) {
      const [times, places, pressure] = await Promise.all(
        [data.scene.times, data.scene.places, data.scene.pressure].map((block) => block && unpack(block)),
      );
      this.planes.push(new Configuration(this, data.scene, { times, places, pressure }));
    }
    if (data.forbidden) this.planes.push(await this.forbidden(data.forbidden));
    if (data.phase) this.planes.push(this.phase());
    this.lay();
    this.listen();
    this.redraw();
  }

  /** The set that a state of one or two components may not enter. */
  async forbidden(data) {
    const [times, inside] = await Promise.all([data.times, data.inside].map(unpack));
    const states = this.panels.filter((panel) => panel.data.title.startsWith("States"));
    const columns = states.flatMap((panel) => panel.columns);
    const labels = states.flatMap((panel) => panel.columns.map((one) => withUnit(one.name, panel.data.unit)));
    return new Forbidden(
      this,
      data,
      { times, inside },
      columns,
      columns.length === 2 ? labels : [this.timeLabel, labels[0]],
    );
  }

  /** The phase plane over all columns of the first clock. */
  phase() {
    const columns = [];
    const chosen = this.data.phase;
    const places = chosen.map(() => 0);
    this.panels.forEach(
      (panel, p) =>
        panel.data.clock === 0 &&
        panel.columns?.forEach((column, c) => {
          chosen.forEach(([p0, c0], i) => {
            if (p0 === p && c0 === c) places[i] = columns.length;
          });
          columns.push({ ...column, label: withUnit(column.name, panel.data.unit) });
        }),
    );
    return new Phase(this, columns, places);
  }

  /** Puts all parts on the page. */
  lay() {
    const { data } = this;
    const page = document.getElementById("page");
    const badge = element("span", `badge ${data.status === "done" ? "good" : "bad"}`, data.status);
    const facts = element("dl");
    for (const [label, lines] of data.facts) {
      facts.append(element("dt", "", label), ...lines.map((words) => element("dd", "", words)));
    }
    const warned = data.facts.filter(([label]) => label === "warnings").flatMap(([, lines]) => lines);
    const message =
      data.status === "done" ? [] : data.facts.filter(([label]) => label === "status").flatMap(([, lines]) => lines);
    page.append(
      element("h1", "", data.title, " ", badge),
      ...message.map((words) => element("p", "stopped", words)),
      ...warned.map((words) => element("p", "warned", `Warning: ${words}`)),
      element("p", "note", data.note),
      element("details", "facts", "", element("summary", "", "Summary of the run"), facts),
      this.bar(),
    );
    const columns = element("div", "columns");
    const over = element("div", "over", "", ...this.panels.map((panel) => panel.root));
    columns.append(over);
    if (this.planes.length)
      columns.append(
        element("aside", data.scene || data.forbidden ? "first" : "", "", ...this.planes.map((plane) => plane.root)),
      );
    page.append(columns, element("p", "note foot", HELP));
  }

  /** Play, slider, time, reset, and which panels are seen. */
  bar() {
    this.play = element("button", "", "Play");
    this.slider = element("input");
    Object.assign(this.slider, { type: "range", min: 0, max: this.clock.n - 1, step: 1, value: 0 });
    this.slider.setAttribute("aria-label", "row");
    this.told = element("output", "told");
    this.whole = element("button", "", "Whole run");
    const chips = this.panels.map((panel) =>
      toggle(panel.title, panel.open, (now) => {
        panel.open = now;
        panel.root.hidden = !now;
        this.redraw();
      }),
    );
    return element(
      "nav",
      "bar",
      "",
      element("div", "run", "", this.play, this.slider, this.whole),
      this.told,
      element("div", "chips which", "", ...chips),
    );
  }

  listen() {
    this.play.addEventListener("click", () => this.toggle());
    this.whole.addEventListener("click", () => this.reset());
    this.slider.addEventListener("input", () => this.select(Number(this.slider.value)));
    for (const panel of this.panels) this.point(panel);
    window.addEventListener("resize", () => this.redraw());
    window.addEventListener("scroll", () => this.redraw(), { passive: true });
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      palette.clear();
      this.redraw();
    });
    window.addEventListener("keydown", (event) => this.key(event));
  }

  /** What a pointer does on a panel over time. */
  point(panel) {
    const band = element("div", "select");
    band.hidden = true;
    panel.plot.append(band);
    const wide = () => panel.canvas.clientWidth - LEFT - RIGHT;
    const time = (x) => this.t0 + ((x - LEFT) / wide()) * (this.t1 - this.t0);
    gestures(panel.canvas, {
      hover: (x) => this.playing || this.select(this.nearest(time(x))),
      pan: (dx) =>
        this.show(this.t0 - (dx / wide()) * (this.t1 - this.t0), this.t1 - (dx / wide()) * (this.t1 - this.t0)),
      zoom: (factor, x) => this.zoom(factor, time(x)),
      reset: () => this.reset(),
      selects: (event) => event.pointerType === "mouse" && (event.shiftKey || this.isWhole),
      selecting: (from, to) => {
        band.hidden = from === null;
        if (from === null) return;
        const [a, b] = [from, to].map((x) => Math.max(LEFT, Math.min(LEFT + wide(), x))).sort((u, v) => u - v);
        Object.assign(band.style, { left: `${a}px`, width: `${b - a}px` });
      },
      select: (from, to) => this.show(...[time(from), time(to)].sort((u, v) => u - v)),
    });
  }

  key(event) {
    if (event.target.matches?.("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
    const width = this.t1 - this.t0;
    const row = entryAt(this.clock, this.t);
    const does = {
      ArrowLeft: () => (event.shiftKey ? this.show(this.t0 - width / 4, this.t1 - width / 4) : this.select(row - 1)),
      ArrowRight: () => (event.shiftKey ? this.show(this.t0 + width / 4, this.t1 + width / 4) : this.select(row + 1)),
      "+": () => this.zoom(0.5, this.t),
      "=": () => this.zoom(0.5, this.t),
      "-": () => this.zoom(2, this.t),
      0: () => this.reset(),
      Escape: () => this.reset(),
      " ": () => !event.target.matches?.("button, summary") && this.toggle(),
    }[event.key];
    if (does && does() !== false) event.preventDefault();
  }

  get isWhole() {
    return this.t0 <= this.span[0] && this.t1 >= this.span[1];
  }

  /** Shows the times from a to b, moved into the run; returns whether that is anything new. */
  show(a, b) {
    const [start, end] = this.span;
    const width = Math.min(end - start, Math.max(b - a, DEEPEST * (end - start)));
    const from = Math.min(Math.max(a, start), end - width);
    const to = width === end - start ? end : from + width;
    if (from === this.t0 && to === this.t1) return false;
    [this.t0, this.t1] = [from, to];
    this.redraw();
    return true;
  }

  zoom(factor, t) {
    const middle = Math.min(Math.max(t, this.t0), this.t1);
    return this.show(middle + (this.t0 - middle) * factor, middle + (this.t1 - middle) * factor);
  }

  reset() {
    for (const plane of this.planes) plane.box = null;
    [this.t0, this.t1] = this.span;
    this.redraw();
  }

  /** The row next to a time; of rows that are held as one those that it is among. */
  nearest(t) {
    const k = entryAt(this.clock, t);
    const { T, n, width } = this.clock;
    return width === 1 && k + 1 < n && T[k + 1] - t < t - T[k] ? k + 1 : k;
  }

  /** Puts the cursor at a row (of many rows: at the first of those that are held as one). */
  select(row) {
    const k = Math.min(Math.max(row, 0), this.clock.n - 1);
    this.t = this.clock.T[k];
    this.row = k;
    this.order("cursor");
  }

  toggle() {
    this.playing = !this.playing;
    this.play.textContent = this.playing ? "Pause" : "Play";
    let last = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      const next = this.clockTime + ((now - last) / 1000 / LASTS) * (this.t1 - this.t0);
      last = now;
      if (next > this.t1) this.toggle();
      this.clockTime = Math.min(next, this.t1);
      this.select(entryAt(this.clock, this.clockTime));
      if (this.playing) requestAnimationFrame(step);
    };
    this.clockTime = this.t >= this.t1 || this.t < this.t0 || this.row === this.clock.n - 1 ? this.t0 : this.t;
    if (this.playing) requestAnimationFrame(step);
  }

  redraw() {
    this.order("window");
  }

  /** Draws at the next frame, once. */
  order(what) {
    const waits = this.waiting.window || this.waiting.cursor;
    this.waiting[what] = true;
    if (!waits) requestAnimationFrame(() => this.draw());
  }

  draw() {
    const begun = performance.now();
    const whole = this.waiting.window;
    this.waiting = { window: false, cursor: false };
    for (const panel of this.panels) {
      if (!panel.open) continue;
      if (whole && panel.visible) panel.draw();
      panel.point();
    }
    for (const plane of this.planes) if (plane.visible) plane.draw();
    const k = entryAt(this.clock, this.t);
    this.row = k;
    this.slider.value = k;
    this.told.textContent = this.tell(k);
    this.frames.push(performance.now() - begun);
    if (this.frames.length > 1000) this.frames.shift();
  }

  /** Where the cursor is: time, row or rows, the event in its step. */
  tell(k) {
    const { width, n } = this.clock;
    const unit = this.data.time.unit ? ` ${this.data.time.unit}` : "";
    const name = this.clocks.length > 1 ? "point" : "row";
    const rows =
      width === 1
        ? `${name} ${k} of ${n - 1}`
        : `rows ${k * width} to ${Math.min((k + 1) * width, this.data.rows) - 1}`;
    return `t = ${number(this.t, 8)}${unit}   ${rows}${this.happens(k)}`;
  }

  /** The first event after the row before row k, and until row k. */
  happens(k) {
    if (!this.events) return "";
    const { T } = this.clock;
    const { times, count, words } = this.events;
    let before = k;
    while (before > 0 && T[before - 1] === T[k]) before--;
    let event = before > 0 ? firstFrom(times, T[before - 1]) : 0;
    while (before > 0 && times[event] === T[before - 1]) event++;
    if (!(times[event] <= T[k])) return "";
    return `   event ${event + 1} of ${count}${words[event] ? ` (${words[event]})` : ""}`;
  }
}

const HELP =
  "Wheel or pinch: zoom. Drag: choose a time when the whole run is shown (with Shift always), move it otherwise. " +
  "Double click, 0: the whole run. Arrows: one row; with Shift a quarter of the time shown. + and −: zoom. Space: play.";

/** The view, for whoever looks at the page by a program: `ready`, `show(a, b)`, `select(row)`, `reset()`, `frames` (ms each). */
const view = new View(JSON.parse(document.getElementById("data").textContent));
window.nsview = view;
view.ready = view.build().catch((error) => {
  document.getElementById("page").append(element("p", "stopped", `This browser cannot show the page (${error}).`));
  throw error;
});
