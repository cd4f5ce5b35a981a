// Which charts there are: those of each fish, its controller and its sensors; and how this browser orders them.
import { recall, remember, unitText } from "./common.js";
import { QUANTITY, READING } from "./ring.js";

const line = (column, stroke, more = {}) => ({ column, stroke, width: 1.5, ...more });
const points = (column) => ({ column, stroke: "suspect", isPoints: true });
const invisible = (column) => ({ column, width: 0 });

/** Charts: key, title, unit, series; `force` scales to the fish's unit, `truth` is of a simulated fish only. */
export const CHARTS = [
  {
    key: "fx", title: ["Force F", "x"], force: true, bands: [3, 4],
    series: [line("fx", "fx", { width: 1 }), line("thrust", "thrust", { width: 2, name: "mean" }),
      invisible("thrust_high"), invisible("thrust_low"), points("suspect_fx")],
  },
  {
    key: "thrust", title: ["Thrust, with its 95 % interval"], force: true, virtual: true, bands: [2, 3],
    series: [line("thrust", "thrust", { width: 2 }), invisible("thrust_high"), invisible("thrust_low")],
  },
  { key: "fy", title: ["Force F", "y"], force: true, series: [line("fy", "fy"), points("suspect_fy")] },
  {
    key: "phi", title: ["Command φ", "c"], unit: "rad", limits: true,
    series: [line("phi_c", "phi", { isStepped: true, name: "command" }), line("phi", "alpha", { name: "wheel" })],
  },
  { key: "fin_velocity", title: ["Fin velocity, estimated"], series: [line("fin_velocity", "fin")] },
  { key: "alpha", title: ["Fin angle α, true"], unit: "rad", smallest: 0.1, truth: true, series: [line("alpha", "alpha")] },
  { key: "speed", title: ["Speed, true"], unit: "m/s", truth: true, series: [line("speed", "fin")] },
];

/** Return a chart whose quantity or reading is not known yet. */
export const namedChart = () => ({ title: [""], series: [line("", "fin")] });

/** Return column, title, unit and description of each quantity of the controller and each reading of the sensors. */
export const namedColumns = (status, controller) => [
  ...(controller?.quantities ?? []).map((one) => ({ ...one, column: QUANTITY + one.name, title: `${controller.name}: ${one.name}` })),
  ...Object.entries(status?.readings ?? {}).map(([name, one]) => ({ ...one, column: READING + name, title: name })),
].map((one) => ({ ...one, title: [one.title.replaceAll("_", " ")], unit: unitText(one.unit) }));

/** The order of the charts in this browser, and which are hidden. */
export class Arrangement {
  constructor() {
    Object.assign(this, { order: [], hidden: [], ...recall("charts", {}) });
  }

  /** Return charts in this order; those that were never moved are last. */
  sort(charts) {
    const place = ({ key }) => (this.order.includes(key) ? this.order.indexOf(key) : this.order.length);
    return [...charts].sort((one, other) => place(one) - place(other));
  }

  /** Move a chart among the others by some places, forward if `by` is negative. */
  move(charts, key, by) {
    const keys = this.sort(charts).map((chart) => chart.key), from = keys.indexOf(key);
    keys.splice(from + by, 0, ...keys.splice(from, 1));
    this.#keep([...keys, ...this.order.filter((other) => !keys.includes(other))], this.hidden);
  }

  show(key, isShown) {
    this.#keep(this.order, [...this.hidden.filter((other) => other !== key), ...(isShown ? [] : [key])]);
  }

  #keep(order, hidden) {
    remember("charts", Object.assign(this, { order, hidden }));
  }
}
