// The rows of an experiment as a chart: one column over another, with its intervals.
import { colourOf, drawPlot, html, useLayoutEffect, useRef, useState } from "./common.js";

const HEIGHT = 220;
const COLOURS = ["thrust", "phi", "fy", "fin", "alpha", "fx"];
/** Quantities of results: title, factor from SI units, and unit. */
export const QUANTITIES = {
  thrust: ["thrust", 1e3, "mN"],
  speed: ["speed", 1e3, "mm/s"],
  frequency: ["frequency", 1, "Hz"],
  power: ["power", 1e3, "mW"],
  thrust_per_watt: ["efficiency", 1e3, "mN/W"],
  relative_thrust: ["of the best square wave", 100, "%"],
  fin_angle_max: ["largest fin angle", 1e3, "mrad"],
};

/** Return title, factor and unit of a quantity, or of another column; forces are in the unit of the sensor. */
export function quantityOf(name, forceUnit = "N") {
  const [title, factor, unit] = QUANTITIES[name] ?? [name.replace(/^parameters\./, "").replaceAll("_", " "), 1, ""];
  return [title, factor, name.startsWith("thrust") ? unit.replace("N", forceUnit) : unit];
}

export function Rows({ result: { columns, labels, name: run, force_unit: forceUnit } }) {
  const names = Object.keys(columns).filter((name) => !name.endsWith("_ci95")), node = useRef(null);
  const varied = names.filter((name) => new Set(columns[name]).size > 1);
  const [x, setX] = useState(varied[0] ?? names[0]);
  const [y, setY] = useState(["thrust", "speed"].find((name) => names.includes(name)) ?? names.at(-1));
  const groups = [...new Set(labels)];
  useLayoutEffect(() => {
    const [, factor] = quantityOf(y), [, scale] = quantityOf(x), half = columns[`${y}_ci95`] ?? [];
    const order = columns[x].map((_, row) => row).filter((row) => columns[x][row] !== null && columns[y][row] !== null)
      .sort((a, b) => columns[x][a] - columns[x][b]);
    const scaled = (column, row) => (column[row] == null ? null : factor * column[row]);
    const data = [order.map((row) => scale * columns[x][row]),
      ...groups.map((group) => order.map((row) => (labels[row] === group ? scaled(columns[y], row) : null)))];
    const colour = (index) => colourOf(COLOURS[index % COLOURS.length]);
    const drawBars = (plot, index) => {
      const { ctx } = plot;
      ctx.strokeStyle = colour(index - 1);
      ctx.beginPath();
      order.forEach((row, place) => {
        const value = data[index][place], error = scaled(half, row);
        if (value === null || error === null) return;
        const left = plot.valToPos(data[0][place], "x", true);
        ctx.moveTo(left, plot.valToPos(value - error, "y", true));
        ctx.lineTo(left, plot.valToPos(value + error, "y", true));
      });
      ctx.stroke();
    };
    const range = (low, high) => [low - 0.05 * (high - low || 1), high + 0.05 * (high - low || 1)];
    const known = order.flatMap((row) => [-1, 1].map((sign) => scaled(columns[y], row) + sign * (scaled(half, row) ?? 0)));
    const ends = known.length > 0 ? known : [0, 1];
    const [, remove] = drawPlot(node.current, {
      height: HEIGHT, padding: [10, 12, 0, 0], hooks: { drawSeries: [drawBars] },
      scales: { x: { time: false, range: (_, low, high) => range(low ?? 0, high ?? 1) }, y: { range: () => range(Math.min(...ends), Math.max(...ends)) } },
      axes: [{ size: 24 }, { size: 52 }],
      series: [{}, ...groups.map((_, index) => ({
        stroke: colour(index), paths: () => null, points: { show: true, size: 7, fill: colour(index) },
      }))],
    }, data);
    return remove;
  }, [columns, x, y]);
  const titleOf = (name) => {
    const [title, , unit] = quantityOf(name, forceUnit);
    return unit ? `${title} [${unit}]` : title;
  };
  const choose = (label, value, set) => html`<label>${label} <select value=${value} onChange=${(event) => set(event.target.value)}>
    ${names.map((name) => html`<option value=${name}>${titleOf(name)}</option>`)}</select></label>`;
  return html`<figure class="chart curve rows"><figcaption class="filter">${choose("Rows:", y, setY)}${choose("over", x, setX)}
    ${groups.length > 1 && html`<span class="keys">${groups.map((group, index) => html`<span style=${`--key: var(--${COLOURS[index % COLOURS.length]})`}>${group}</span>`)}</span>`}
    </figcaption><div class="plot" role="img" aria-label=${`Chart of the rows of ${run}: ${y} over ${x}`} ref=${node}></div></figure>`;
}
