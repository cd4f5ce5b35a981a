// A finished curve of forces over its own time, which begins at zero: it does not move with the live charts.
import { colourOf, drawPlot, html, useLayoutEffect, useRef } from "./common.js";

const HEIGHT = 150;
const milli = (column) => column.map((value) => (value === null ? null : 1000 * value));

/** curve: columns time [s], fx and thrust [N] of a simulated fish */
export function Curve({ curve, title }) {
  const node = useRef(null);
  useLayoutEffect(() => {
    const start = curve.time[0] ?? 0, data = [curve.time.map((time) => time - start), milli(curve.fx), milli(curve.thrust)];
    const [, remove] = drawPlot(node.current, {
      height: HEIGHT, padding: [6, 12, 0, 0], scales: { x: { time: false } },
      axes: [{ size: 24, values: (_, splits) => splits.map((x) => `${x} s`) }, { size: 44 }],
      series: [{}, { stroke: () => colourOf("fx"), width: 1, points: { show: false } },
        { stroke: () => colourOf("virtual"), width: 2, points: { show: false } }],
    }, data);
    return remove;
  }, [curve]);
  return html`<figure class="chart curve"><figcaption><span>${title} [mN]</span>
    <span class="keys"><span style="--key: var(--fx)">F<sub>x</sub></span><span style="--key: var(--virtual)">mean</span></span></figcaption>
    <div class="plot" role="img" aria-label=${`Chart of ${title}`} ref=${node}></div></figure>`;
}
