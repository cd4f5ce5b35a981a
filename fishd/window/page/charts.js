// The charts: one uPlot each, made once; only their data, titles and ranges change.
import { forceUnit, number, unitText } from "./common.js";
import { QUANTITY, READING } from "./stream.js";

const HEIGHT = 132;
/** Number of charts for the quantities of a controller and the readings of sensors. */
const NAMED_CHARTS = 20;
const FRAME_MS = 50;
/** A range shrinks when its values fill less than this fraction of it. */
const SHRINK = 0.45;

const palette = {};
const COLOURS = ["fx", "fy", "phi", "fin", "alpha", "thrust", "virtual", "band", "suspect", "grid", "muted", "mark"];
function readPalette() {
  const style = getComputedStyle(document.documentElement);
  for (const name of COLOURS) palette[name] = style.getPropertyValue(`--${name}`).trim();
}
const colour = (name) => () => palette[name];

const line = (column, name, more = {}) => ({ column, stroke: colour(name), width: 1.5, ...more });
const points = (column) => ({
  column,
  stroke: colour("suspect"),
  paths: () => null,
  points: { show: true, size: 7, fill: colour("suspect"), stroke: colour("suspect") },
});
const invisible = (column) => ({ column, width: 0, points: { show: false }, aside: true });

/** Charts: key, title, unit, series; `force` scales to the fish's unit, `truth` is of a simulated fish only. */
const CHARTS = [
  {
    key: "fx", title: ["Force F", "x"], force: true,
    series: [line("fx", "fx", { width: 1 }), line("thrust", "thrust", { width: 2, name: "mean" }),
      invisible("thrust_high"), invisible("thrust_low"), points("suspect_fx")],
    bands: [{ series: [3, 4], fill: colour("band") }],
  },
  {
    key: "thrust", title: ["Thrust, with its 95 % interval"], force: true, virtual: true,
    series: [line("thrust", "thrust", { width: 2 }), invisible("thrust_high"), invisible("thrust_low")],
    bands: [{ series: [2, 3], fill: colour("band") }],
  },
  { key: "fy", title: ["Force F", "y"], force: true, series: [line("fy", "fy"), points("suspect_fy")] },
  {
    key: "phi", title: ["Command φ", "c"], unit: "rad", limits: true, stepped: true,
    series: [line("phi_c", "phi", { stepped: true, name: "command" }), line("phi", "alpha", { name: "wheel" })],
  },
  { key: "fin_velocity", title: ["Fin velocity, estimated"], unit: "", series: [line("fin_velocity", "fin")] },
  { key: "alpha", title: ["Fin angle α, true"], unit: "rad", smallest: 0.1, truth: true, series: [line("alpha", "alpha")] },
  { key: "speed", title: ["Speed, true"], unit: "m/s", truth: true, series: [line("speed", "fin")] },
];

/** Return a range around the values that does not follow each of their movements; smallestOf: returns its least width. */
function steadyRange(smallestOf, limitsOf) {
  let low = NaN, high = NaN;
  return (chart, least, most) => {
    const limits = limitsOf();
    if (limits) return [limits[0] * 1.15, limits[1] * 1.15];
    if (!Number.isFinite(least)) return Number.isFinite(low) ? [low, high] : [-1, 1];
    const middle = 0.5 * (least + most);
    const span = Math.max(most - least, smallestOf(), 1e-3 * Math.abs(most));
    [least, most] = [middle - 0.5 * span, middle + 0.5 * span];
    if (!(least >= low && most <= high && span > SHRINK * (high - low))) {
      const step = 10 ** Math.floor(Math.log10(span)) / 2;
      low = Math.floor((least - 0.08 * span) / step) * step;
      high = Math.ceil((most + 0.08 * span) / step) * step;
    }
    return [low, high];
  };
}

/** Return the number of decimals that a step such as 0.25 needs. */
function decimalsOf(step) {
  for (let decimals = 0; decimals < 9; decimals++) if (Math.abs(step - step.toFixed(decimals)) < 1e-6 * step) return decimals;
  return 9;
}

class Chart {
  constructor(parent, definition, owner) {
    this.definition = definition;
    this.owner = owner;
    this.root = parent.appendChild(document.createElement("figure"));
    this.root.className = "chart";
    const caption = this.root.appendChild(document.createElement("figcaption"));
    this.titleNode = caption.appendChild(document.createElement("span"));
    this.keys = caption.appendChild(document.createElement("span"));
    this.keys.className = "keys";
    this.readout = caption.appendChild(document.createElement("output"));
    this.plotNode = this.root.appendChild(document.createElement("div"));
    this.plotNode.className = "plot";
    this.visible = true;
    this.factor = 1;
    this.unit = definition.unit ?? "";
    this.setTitle(definition.title);
    for (const { name, stroke, column } of definition.series) if (name) this.#key(name, stroke, column);
    this.data = [owner.times, ...definition.series.map(() => owner.newColumn())];
    this.plot = new globalThis.uPlot(this.#options(), this.data, this.plotNode);
    this.plot.setScale("x", { min: -owner.seconds, max: 0 });
    this.size();
  }

  setTitle([text, index]) {
    const unit = this.unit ? ` [${this.unit}]` : "";
    const sub = document.createElement("sub");
    sub.textContent = index ?? "";
    this.titleNode.replaceChildren(text, ...(index ? [sub] : []), unit);
    this.plotNode.setAttribute("role", "img");
    this.plotNode.setAttribute("aria-label", `Chart of ${text}${index ? `_${index}` : ""}${unit}`);
  }

  setUnit(unit, factor = 1) {
    if (unit === this.unit && factor === this.factor) return;
    Object.assign(this, { unit, factor });
    this.setTitle(this.definition.title);
  }

  show(visible) {
    this.root.hidden = !visible;
  }

  size() {
    const width = this.plotNode.clientWidth;
    if (width > 0 && width !== this.plot.width) this.plot.setSize({ width, height: HEIGHT });
  }

  fill(ring) {
    this.definition.series.forEach(({ column }, index) => ring.copy(column, this.data[index + 1], this.factor));
  }

  /** Show the keys of the lines that have values. */
  showKeys(ring) {
    for (const key of this.keys.children) key.hidden = !ring.has(key.dataset.column);
  }

  draw(low, high) {
    this.plot.batch(() => {
      this.plot.setData(this.data, false);
      this.plot.setScale("x", { min: low, max: high });
    });
    this.read();
  }

  /** Write the values at the cursor, or the latest ones, beside the title. */
  read() {
    const index = this.plot.cursor.idx ?? this.data[0].length - 1;
    const value = this.data[1][index];
    const { min, max } = this.plot.scales.y;
    this.readout.value = value == null ? "–" : number(value, Math.max(0, 2 - Math.floor(Math.log10(max - min))));
  }

  #key(name, stroke, column) {
    const key = this.keys.appendChild(document.createElement("span"));
    key.dataset.column = column;
    key.textContent = name;
    key.style.setProperty("--key", stroke());
  }

  #options() {
    const { uPlot } = globalThis;
    const font = "11px system-ui, sans-serif";
    const axis = { stroke: colour("muted"), font, ticks: { show: false }, grid: { stroke: colour("grid"), width: 1 } };
    const { definition, owner } = this;
    return {
      width: 300,
      height: HEIGHT,
      padding: [definition.labelled ? 15 : 6, 16, 0, 0],
      pxAlign: 1,
      legend: { show: false },
      cursor: { sync: { key: "fish", setSeries: false }, drag: { x: false, y: false }, points: { size: 6 } },
      scales: { x: { time: false, auto: false }, y: { range: steadyRange(() => this.factor * (definition.smallest ?? 1e-3), () => definition.limits && owner.limits) } },
      axes: [
        {
          ...axis, size: 22, gap: 2,
          splits: (plot, index, low, high) => owner.secondsBack().map((back) => high - back),
          values: (plot, splits) => splits.map((x, index) => {
            const back = Math.round(plot.scales.x.max - x);
            return index === 0 ? "" : back ? `−${back} s` : "latest";
          }),
        },
        {
          ...axis, size: 50, gap: 4, space: 26,
          values: (plot, splits, index, space, step) =>
            splits.map((y) => number(y, decimalsOf(step))),
        },
      ],
      series: [{}, ...definition.series.map(({ column, aside, stepped, name, ...series }) => ({
        spanGaps: false,
        points: { show: false },
        ...series,
        ...(stepped ? { paths: uPlot.paths.stepped({ align: 1 }) } : {}),
      }))],
      bands: definition.bands,
      hooks: {
        drawAxes: [(plot) => this.#drawBehind(plot)],
        draw: [(plot) => this.#drawMarks(plot)],
        setCursor: [() => this.read()],
      },
    };
  }

  /** Draw gaps as hatched areas, limits and the virtual result as dashed lines. */
  #drawBehind(plot) {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.fillStyle = palette.grid;
    for (const [from, to] of this.owner.gaps) {
      const left = plot.valToPos(from, "x", true), right = plot.valToPos(to, "x", true);
      ctx.fillRect(left, bbox.top, Math.max(2, right - left), bbox.height);
    }
    const horizontal = (value, name) => {
      const y = plot.valToPos(value, "y", true);
      ctx.strokeStyle = palette[name];
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    };
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
    const { limits, virtual } = this.owner;
    if (this.definition.limits && limits) for (const limit of limits) horizontal(limit, "muted");
    if (this.definition.virtual && virtual != null) horizontal(virtual * this.factor, "virtual");
    ctx.restore();
  }

  /** Draw where a controller or parameters changed; the first chart names the tick. */
  #drawMarks(plot) {
    const { ctx, bbox } = plot;
    const { min, max } = plot.scales.x;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = palette.mark;
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([2 * devicePixelRatio, 2 * devicePixelRatio]);
    ctx.font = `${10 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    let free = -Infinity;
    for (const mark of this.owner.marks) {
      if (mark.time < min || mark.time > max) continue;
      const x = plot.valToPos(mark.time, "x", true);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      const text = mark.seq === null ? mark.text : `#${mark.seq} ${mark.text}`;
      const width = ctx.measureText(text).width + 8 * devicePixelRatio;
      if (!this.definition.labelled) continue;
      const left = Math.min(x, bbox.left + bbox.width - width);
      if (left < free) continue;
      ctx.fillText(text, left, bbox.top - 4 * devicePixelRatio);
      free = left + width;
    }
    ctx.restore();
  }
}

/** All charts of a fish over one common time. */
export class Charts {
  constructor(parent, seconds) {
    readPalette();
    this.parent = parent;
    this.seconds = seconds;
    this.length = 2;
    this.times = this.newColumn();
    this.marks = [];
    this.gaps = [];
    this.limits = null;
    this.virtual = null;
    this.names = "";
    this.charts = CHARTS.map((definition, index) => new Chart(parent, { ...definition, labelled: index === 0 }, this));
    this.namedCharts = Array.from({ length: NAMED_CHARTS }, () => new Chart(parent, {
      title: [""], series: [line("", "fin")],
    }, this));
    for (const chart of this.namedCharts) chart.show(false);
    this.all = [...this.charts, ...this.namedCharts];
    this.drawn = 0;
    this.dirty = true;
    new ResizeObserver(() => this.all.forEach((chart) => chart.size())).observe(parent);
    const watch = new IntersectionObserver((entries) => {
      for (const entry of entries) this.all.find(({ root }) => root === entry.target).visible = entry.isIntersecting;
      this.dirty = true;
    }, { rootMargin: "100px" });
    this.all.forEach(({ root }) => watch.observe(root));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      readPalette();
      this.dirty = true;
    });
  }

  newColumn() {
    return new Array(this.length).fill(null);
  }

  /** Use another ring, after a connection or a restart. */
  setRing(ring) {
    this.ring = ring;
    this.setSeconds(this.seconds);
  }

  setSeconds(seconds) {
    this.seconds = seconds;
    this.length = Math.min(this.ring.capacity, Math.ceil(seconds / this.ring.period) + 64);
    this.times = this.newColumn();
    for (const chart of this.all) chart.data = [this.times, ...chart.definition.series.map(() => this.newColumn())];
    this.dirty = true;
  }

  secondsBack() {
    const step = this.seconds / (this.parent.clientWidth < 380 ? 3 : 5);
    return Array.from({ length: Math.round(this.seconds / step) + 1 }, (_, index) => index * step).reverse();
  }

  /** Fit units, limits, quantities of the controller and readings of sensors to the status. */
  setStatus(status, controller) {
    const [factor, unit] = forceUnit(status);
    for (const chart of this.charts) if (chart.definition.force) chart.setUnit(unit, factor);
    this.limits = status ? [status.lowest_angle, status.highest_angle] : null;
    const named = [
      ...(controller?.quantities ?? []).map(({ name, ...about }) => ({ ...about, column: QUANTITY + name, title: `${controller.name}: ${name}` })),
      ...Object.entries(status?.readings ?? {}).map(([name, about]) => ({ ...about, column: READING + name, title: name })),
    ];
    const names = named.map(({ column }) => column).join();
    if (names === this.names) return;
    this.names = names;
    this.namedCharts.forEach((chart, index) => {
      const entry = named[index];
      chart.known = entry !== undefined;
      if (!entry) return chart.show(false);
      chart.definition.title = [entry.title.replaceAll("_", " ")];
      chart.definition.series[0].column = entry.column;
      chart.unit = unitText(entry.unit);
      chart.setTitle(chart.definition.title);
      chart.root.title = entry.description;
    });
    this.dirty = true;
  }

  /** Note a change; its tick is looked up once. */
  mark(time, text) {
    this.marks.push({ time, text, seq: this.ring?.seqAt(time) ?? null });
    if (this.marks.length > 64) this.marks.shift();
    this.dirty = true;
  }

  /** Draw what is in view, if anything is new and the last drawing is old enough. */
  draw(now) {
    if (!this.ring || !this.dirty || now - this.drawn < FRAME_MS - 4) return;
    this.drawn = now;
    this.dirty = false;
    const { ring } = this;
    if (!ring.rows) return;
    ring.copyTimes(this.times);
    this.#findGaps();
    const high = this.times[this.length - 1], low = high - this.seconds;
    for (const mark of this.marks) if (mark.seq === null && mark.time >= low) mark.seq = ring.seqAt(mark.time);
    for (const chart of this.charts) {
      chart.showKeys(ring);
      if (!chart.definition.truth) continue;
      chart.known ||= ring.has(chart.definition.series[0].column);
      chart.show(chart.known);
      chart.size();
    }
    for (const chart of this.namedCharts) {
      if (chart.known && chart.root.hidden && ring.has(chart.definition.series[0].column)) {
        chart.show(true);
        chart.size();
      }
    }
    for (const chart of this.all) {
      if ((chart.drawn && !chart.visible) || chart.root.hidden) continue;
      chart.drawn = true;
      chart.fill(ring);
      chart.draw(low, high);
    }
  }

  /** Draw the thrust of a simulated fish, which may be null, in the chart of the thrust [N]. */
  setVirtual(thrust) {
    if (thrust === this.virtual) return;
    this.virtual = thrust;
    this.dirty = true;
  }

  #findGaps() {
    this.gaps.length = 0;
    const numbers = this.numbers?.length === this.length ? this.numbers : (this.numbers = this.newColumn());
    this.ring.copy("seq", numbers);
    const first = this.length - Math.min(this.ring.rows, this.length);
    for (let i = Math.max(first, 1); i < this.length - 1; i++) {
      if (numbers[i] === null && i > first) this.gaps.push([this.times[i - 1], this.times[i + 1]]);
    }
  }
}
