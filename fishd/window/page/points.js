// The curve of an experiment that grows with each result: points with their intervals.
import { colourOf, drawPlot, html, useEffect, useLayoutEffect, useRef } from "./common.js";

const HEIGHT = 150, MAX_SERIES = 4;
const COLOURS = ["fx", "virtual", "fy", "phi"];

/** Return columns of uPlot, and the half-widths of each series: x, then one column for each series; null where it has no point. */
function columnsOf(points, factor) {
  const names = [...new Set(points.map(({ series = "" }) => series))].slice(0, MAX_SERIES);
  const xs = [...new Set(points.map(({ x }) => x))].sort((a, b) => a - b);
  const rows = names.map(() => xs.map(() => null)), halves = names.map(() => xs.map(() => null));
  for (const { x, y, ci95, series = "" } of points) {
    const row = names.indexOf(series), place = xs.indexOf(x);
    if (row < 0) continue;
    rows[row][place] = y * factor;
    halves[row][place] = ci95 == null ? null : ci95 * factor;
  }
  return { names, data: [xs, ...rows], halves };
}

/** Draw the interval of each point as a vertical line. */
function drawIntervals(plot, halves) {
  const { ctx } = plot;
  ctx.save();
  ctx.lineWidth = devicePixelRatio;
  halves.forEach((column, index) => {
    ctx.strokeStyle = plot.series[index + 1].stroke();
    column.forEach((half, place) => {
      const y = plot.data[index + 1][place];
      if (half === null || y === null) return;
      const x = plot.valToPos(plot.data[0][place], "x", true);
      ctx.beginPath();
      ctx.moveTo(x, plot.valToPos(y - half, "y", true));
      ctx.lineTo(x, plot.valToPos(y + half, "y", true));
      ctx.stroke();
    });
  });
  ctx.restore();
}

/** Return limits that hold all intervals. */
function limitsOf(halves, plot) {
  let low = Infinity, high = -Infinity;
  halves.forEach((column, index) => column.forEach((half, place) => {
    const y = plot.data[index + 1][place];
    if (y === null) return;
    low = Math.min(low, y - (half ?? 0));
    high = Math.max(high, y + (half ?? 0));
  }));
  const margin = 0.08 * (high - low) || 0.1 * Math.abs(high) || 1;
  return low <= high ? [low - margin, high + margin] : [0, 1];
}

/** points: those of an experiment; factor, unit: in which they are shown */
export function Points({ points, factor, unit }) {
  const node = useRef(null), shown = useRef(null);
  const { x_name: xName, y_name: yName = "thrust" } = points[0];
  const columns = columnsOf(points, factor), names = columns.names.join("|");
  useLayoutEffect(() => {
    const state = { halves: columns.halves };
    const [plot, remove] = drawPlot(node.current, {
      height: HEIGHT, padding: [6, 12, 0, 0], scales: { x: { time: false }, y: { range: (own) => limitsOf(state.halves, own) } },
      axes: [{ size: 24 }, { size: 44 }], hooks: { draw: [(own) => drawIntervals(own, state.halves)] },
      series: [{}, ...columns.names.map((_, index) => ({ stroke: () => colourOf(COLOURS[index]), width: 1, spanGaps: true, points: { show: true, size: 6 } }))],
    }, columns.data);
    shown.current = Object.assign(state, { plot });
    return remove;
  }, [names]);
  useEffect(() => {
    shown.current.halves = columns.halves;
    shown.current.plot.setData(columns.data);
  }, [points.length, factor]);
  return html`<figure class="chart curve"><figcaption><span>${yName} [${unit}]</span>
    ${columns.names.length > 1 ? html`<span class="keys">${columns.names.map((name, index) => html`<span style=${`--key: var(--${COLOURS[index]})`}>${name}</span>`)}</span>`
      : html`<span class="muted">over ${xName}</span>`}</figcaption>
    <div class="plot" role="img" aria-label=${`Chart of ${yName} over ${xName}, ${points.length} points`} ref=${node}></div></figure>`;
}
