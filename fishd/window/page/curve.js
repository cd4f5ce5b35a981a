// A finished curve of forces over its own time, which begins at zero: it does not move with the live charts.
import { html, useLayoutEffect, useRef } from "./common.js";

const HEIGHT = 150;
const milli = (column) => column.map((value) => (value === null ? null : 1000 * value));

/** curve: columns time [s], fx and thrust [N] of a simulated fish */
export function Curve({ curve, title }) {
  const node = useRef(null);
  useLayoutEffect(() => {
    const style = getComputedStyle(document.documentElement), colour = (name) => () => style.getPropertyValue(`--${name}`);
    const axis = { stroke: colour("muted"), font: "11px system-ui, sans-serif", ticks: { show: false }, grid: { stroke: colour("grid"), width: 1 } };
    const start = curve.time[0] ?? 0, data = [curve.time.map((time) => time - start), milli(curve.fx), milli(curve.thrust)];
    const plot = new globalThis.uPlot({
      width: node.current.clientWidth, height: HEIGHT, padding: [6, 12, 0, 0], legend: { show: false },
      cursor: { drag: { x: false, y: false } }, scales: { x: { time: false } },
      axes: [{ ...axis, size: 24, values: (_, splits) => splits.map((x) => `${x} s`) }, { ...axis, size: 44 }],
      series: [{}, { stroke: colour("fx"), width: 1, points: { show: false } }, { stroke: colour("virtual"), width: 2, points: { show: false } }],
    }, data, node.current);
    const watch = new ResizeObserver(([{ contentRect }]) => contentRect.width > 0 && plot.setSize({ width: contentRect.width, height: HEIGHT }));
    watch.observe(node.current);
    return () => {
      watch.disconnect();
      plot.destroy();
    };
  }, [curve]);
  return html`<figure class="chart curve"><figcaption><span>${title} [mN]</span>
    <span class="keys"><span style="--key: var(--fx)">F<sub>x</sub></span><span style="--key: var(--virtual)">mean</span></span></figcaption>
    <div class="plot" role="img" aria-label=${`Chart of ${title}`} ref=${node}></div></figure>`;
}
