// The page of a study: seconds over errors, line by line, and all points as a table.

const MARKS = ["●", "■", "◆", "▼", "▲"];

const data = JSON.parse(document.getElementById("data").textContent);

/** Errors across and seconds up, both logarithmic; the box is of exponents. */
class Prices extends Plane {
  constructor() {
    super({}, data.heading, false);
    this.canvas.addEventListener("pointermove", (event) => this.point(event.offsetX, event.offsetY));
    this.canvas.addEventListener("pointerdown", (event) => this.point(event.offsetX, event.offsetY));
    this.lines = data.lines.map((one, k) => {
      const swatch = element("span", `swatch c${k % 8}`);
      const chip = toggle("", true, (now) => {
        this.lines[k].shown = now;
        this.draw();
      });
      chip.append(swatch, element("span", "name", `${MARKS[k % 5]} ${one.name}`));
      if (one.aside) chip.append(element("output", "", one.aside));
      this.controls.append(chip);
      const points = one.points
        .filter((point) => point.drawn)
        .map((point) => ({ ...point, x: Math.log10(point.error), y: Math.log10(point.seconds), line: one.name }));
      return { ...one, points, shown: true };
    });
    this.note.textContent = data.legend;
  }

  ticks(low, high, room) {
    return decades(low, high, room);
  }

  get home() {
    const points = this.lines.filter((one) => one.shown).flatMap((one) => one.points);
    const ends = (key) => {
      const values = points.map((point) => point[key]);
      const [low, high] = values.length ? [Math.min(...values), Math.max(...values)] : [-1, 1];
      const more = 0.06 * (high - low) + 0.15;
      return [low - more, high + more];
    };
    return [...ends("x"), ...ends("y")];
  }

  draw() {
    const ctx = this.frame(data.axes);
    ctx.textBaseline = "middle";
    ctx.textAlign = "center";
    this.lines.forEach((one, k) => {
      if (!one.shown) return;
      ctx.strokeStyle = ctx.fillStyle = colour(`line-${k % 8}`);
      ctx.lineWidth = one.kind === "solver" ? 0.7 : 1.5;
      ctx.setLineDash(one.kind === "peer" ? [6, 4] : one.kind === "solver" ? [2, 3] : []);
      ctx.beginPath();
      one.points.forEach((point, i) => (i ? ctx.lineTo : ctx.moveTo).call(ctx, this.px(point.x), this.py(point.y)));
      ctx.stroke();
      ctx.setLineDash([]);
      for (const point of one.points) {
        ctx.globalAlpha = point.resolved ? 1 : 0.45;
        ctx.fillText(MARKS[k % 5], this.px(point.x), this.py(point.y));
        ctx.globalAlpha = 1;
      }
    });
    const near = this.near;
    if (near) {
      ctx.strokeStyle = colour("ink");
      ctx.lineWidth = 1.5;
      ctx.beginPath();
      ctx.arc(this.px(near.x), this.py(near.y), 8, 0, 7);
      ctx.stroke();
    }
    ctx.restore();
  }

  /** Says which point is next to the pointer. */
  point(x, y) {
    const far = (point) => Math.hypot(this.px(point.x) - x, this.py(point.y) - y);
    const points = this.lines.filter((one) => one.shown).flatMap((one) => one.points);
    this.near = points.reduce((best, point) => (far(point) < (best ? far(best) : 40) ? point : best), null);
    told.textContent = this.near ? `${this.near.line}, ${this.near.words.join(", ")}` : " ";
    this.draw();
  }
}

const told = element("output", "told", " ");
const page = document.getElementById("page");
const facts = element("dl");
for (const [label, lines] of data.facts)
  facts.append(element("dt", "", label), ...lines.map((words) => element("dd", "", words)));
const row = (tag, cells) => element("tr", "", "", ...cells.map((words) => element(tag, "", words)));
const table = element("table", "", "", row("th", data.head), ...data.rows.map((cells) => row("td", cells)));
page.append(element("h1", "", data.title), facts);
const prices = data.lines.some((one) => one.points.some((point) => point.drawn)) ? new Prices() : null;
if (prices) page.append(prices.root, told);
page.append(
  element("div", "wide", "", table),
  element("details", "", "", element("summary", "", "As text"), element("pre", "wide", data.text)),
);
if (prices) {
  prices.draw();
  window.addEventListener("resize", () => prices.draw());
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    palette.clear();
    prices.draw();
  });
}
