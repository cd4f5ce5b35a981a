// One chart: a uPlot, made once; only its data, title and ranges change.
import { html, number, render, timeOfDay } from "./common.js";
import { followPointers } from "./gestures.js";

const HEIGHT = 132;
/** A range shrinks when its values fill less than this fraction of it. */
const SHRINK = 0.45;
/** Width below which fewer times are labelled [px]. */
const NARROW_PX = 320;

export const palette = {};
const COLOURS = "fx fy phi fin alpha thrust virtual band suspect grid muted mark accent surface text".split(" ");
/** Read the colours of the page, which are light or dark. */
export function readPalette() {
  const style = getComputedStyle(document.documentElement);
  for (const name of COLOURS) palette[name] = style.getPropertyValue(`--${name}`).trim();
}
const colour = (name) => () => palette[name];

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

/** Draw a line across a plot, or from its top to its bottom. */
function strokeLine({ ctx, bbox: { left, top, width, height } }, { x, y }) {
  ctx.beginPath();
  ctx.moveTo(x ?? left, y ?? top);
  ctx.lineTo(x ?? left + width, y ?? top + height);
  ctx.stroke();
}

/** One chart; its owner has the view, times, marks, gaps, limits and cursor of all charts. */
export class Chart {
  constructor(parent, definition, owner) {
    Object.assign(this, { definition, owner, visible: true, factor: 1, unit: definition.unit ?? "" });
    this.known = !definition.truth && definition.key !== undefined;
    this.root = parent.appendChild(document.createElement("figure"));
    this.root.className = "chart";
    render(html`<figcaption><span /><span class="keys">${definition.series.filter(({ name }) => name).map(({ name, stroke, column }) =>
      html`<span data-column=${column} style=${{ "--key": `var(--${stroke})` }}>${name}</span>`)}</span><output aria-live="off" /></figcaption>
      <div class="plot" tabindex="0" role="application" aria-roledescription="chart" aria-describedby="chart-help" />`, this.root);
    [this.titleNode, this.keys, this.readout] = this.root.firstChild.children;
    this.plotNode = this.root.lastChild;
    this.setTitle();
    this.data = [owner.times, ...definition.series.map(() => owner.newColumn())];
    this.plot = new globalThis.uPlot(this.#options(), this.data, this.plotNode);
    this.size();
    followPointers(this.plot.over, owner.actions);
    this.plotNode.addEventListener("keydown", (event) => owner.press(event, this));
  }

  /** Name of this chart in the order of the charts. */
  get key() {
    return this.definition.key ?? this.definition.series[0].column;
  }

  /** Title with an index as in F_x, and the unit. */
  get text() {
    const [text, index] = this.definition.title;
    return text + (index ? `_${index}` : "") + (this.unit ? ` [${this.unit}]` : "");
  }

  setTitle() {
    const [text, index] = this.definition.title, sub = document.createElement("sub");
    sub.textContent = index;
    this.titleNode.replaceChildren(text, ...(index ? [sub] : []), this.unit ? ` [${this.unit}]` : "");
    this.plotNode.setAttribute("aria-label", `Chart of ${this.text}`);
  }

  setUnit(unit, factor = 1) {
    Object.assign(this, { unit, factor });
    this.setTitle();
  }

  /** Show a quantity or reading; see `namedColumns`. */
  setColumn({ column, title, unit, description }) {
    Object.assign(this.definition, { title, series: [{ ...this.definition.series[0], column }] });
    this.root.title = description;
    this.setUnit(unit);
  }

  size() {
    const width = this.plotNode.clientWidth;
    if (width > 0 && width !== this.plot.width) this.plot.setSize({ width, height: HEIGHT });
  }

  /** Take the values of the view, and show the keys of the lines that have some. */
  fill(level, skip) {
    this.data[0] = this.owner.times;
    for (const key of this.keys.children) key.hidden = !level.has(key.dataset.column);
    this.definition.series.forEach(({ column }, index) => {
      if (this.data[index + 1].length !== this.owner.length) this.data[index + 1] = this.owner.newColumn();
      level.copy(column, this.data[index + 1], this.factor, skip);
    });
  }

  draw(min, max) {
    this.plot.batch(() => {
      this.plot.setData(this.data, false);
      this.plot.setScale("x", { min, max });
      if (this.isLive !== this.owner.view.isLive) this.plot.redraw(false, true); // "latest" and times are other labels
    });
    this.isLive = this.owner.view.isLive;
    this.read();
  }

  /** Write the values at the pointer, else at the cursor, or the latest ones, beside the title. */
  read() {
    const { plot, owner, data: [times, values] } = this, { idx } = plot.cursor;
    const value = values[idx ?? (owner.cursor === null ? times.length - 1 : plot.valToIdx(owner.cursor))];
    const { min, max } = plot.scales.y;
    this.readout.value = value == null ? "–" : number(value, Math.max(0, 2 - Math.floor(Math.log10(max - min))));
    if (owner.first === this) owner.showTime(idx == null ? owner.cursor : times[idx]);
  }

  #options() {
    const { uPlot } = globalThis, { definition, owner } = this;
    const font = "11px system-ui, sans-serif";
    const axis = { stroke: colour("muted"), font, ticks: { show: false }, grid: { stroke: colour("grid"), width: 1 } };
    const labels = (plot) => owner.view.labels(plot.width < NARROW_PX ? 3 : 6);
    return {
      width: 300,
      height: HEIGHT,
      padding: [() => (owner.first === this ? 15 : 6), () => (owner.view.isLive ? 16 : 28), 0, 0],
      pxAlign: 1,
      legend: { show: false },
      cursor: { sync: { key: "fish", setSeries: false }, drag: { x: false, y: false }, points: { size: 6 } },
      scales: {
        x: { time: false, auto: false, min: -owner.view.seconds, max: 0 },
        y: { range: steadyRange(() => this.factor * (definition.smallest ?? 1e-3), () => definition.limits && owner.limits) },
      },
      axes: [
        {
          ...axis, size: 22, gap: 2,
          splits: (plot, index, low, high) => labels(plot)[0].map((back) => high - back),
          values: (plot) => {
            const [backs, step] = labels(plot);
            const end = owner.view.isLive ? "latest" : timeOfDay(owner.ring.unixTime(owner.view.high));
            return backs.map((back) => (!back ? end : back > 0.97 * owner.view.seconds ? ""
              : step >= 60 ? `−${back / 60} min` : `−${back.toFixed(decimalsOf(step))} s`));
          },
        },
        { ...axis, size: 50, gap: 4, space: 26, values: (plot, splits, index, space, step) => splits.map((y) => number(y, decimalsOf(step))) },
      ],
      series: [{}, ...definition.series.map(({ width, stroke, isPoints, isStepped }) => ({
        width,
        spanGaps: false,
        points: isPoints ? { show: true, size: 7, fill: colour(stroke), stroke: colour(stroke) } : { show: false },
        ...(stroke ? { stroke: colour(stroke) } : {}),
        ...(isStepped ? { paths: uPlot.paths.stepped({ align: 1 }) } : isPoints ? { paths: () => null } : {}),
      }))],
      bands: definition.bands && [{ series: definition.bands, fill: colour("band") }],
      hooks: {
        drawAxes: [(plot) => this.#drawBehind(plot)],
        draw: [(plot) => this.#drawMarks(plot)],
        setCursor: [() => this.read()],
      },
    };
  }

  /** Draw gaps as areas, limits and the virtual result as dashed lines. */
  #drawBehind(plot) {
    const { ctx, bbox } = plot, { gaps, limits, virtual } = this.owner;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.fillStyle = palette.grid;
    for (const [from, to] of gaps) {
      const left = plot.valToPos(from, "x", true), right = plot.valToPos(to, "x", true);
      ctx.fillRect(left, bbox.top, Math.max(2, right - left), bbox.height);
    }
    const horizontal = (value, name) => {
      ctx.strokeStyle = palette[name];
      strokeLine(plot, { y: plot.valToPos(value, "y", true) });
    };
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
    if (this.definition.limits && limits) for (const limit of limits) horizontal(limit, "muted");
    if (this.definition.virtual && virtual != null) horizontal(virtual * this.factor, "virtual");
    ctx.restore();
  }

  /** Draw the cursor, and where something changed or a mark is; the first chart names the tick. */
  #drawMarks(plot) {
    const { ctx, bbox, scales: { x: { min, max } } } = plot, { cursor, first, marks } = this.owner;
    const vertical = (x) => strokeLine(plot, { x });
    ctx.save();
    ctx.lineWidth = devicePixelRatio;
    ctx.strokeStyle = palette.accent;
    if (cursor !== null && cursor >= min && cursor <= max) vertical(plot.valToPos(cursor, "x", true));
    ctx.strokeStyle = ctx.fillStyle = palette.mark;
    ctx.setLineDash([2 * devicePixelRatio, 2 * devicePixelRatio]);
    Object.assign(ctx, { font: `${10 * devicePixelRatio}px system-ui, sans-serif`, textAlign: "left", textBaseline: "alphabetic" });
    let free = -Infinity;
    for (const mark of marks) {
      if (!(mark.time >= min && mark.time <= max)) continue;
      const x = plot.valToPos(mark.time, "x", true);
      vertical(x);
      const text = mark.seq === null ? mark.text : `#${mark.seq} ${mark.text}`;
      const width = ctx.measureText(text).width + 8 * devicePixelRatio;
      const left = Math.min(x, bbox.left + bbox.width - width);
      if (first !== this || left < free) continue;
      ctx.fillText(text, left, bbox.top - 4 * devicePixelRatio);
      free = left + width;
    }
    ctx.restore();
  }
}
