// The progress of an experiment: how much is done, the best values until now, and their curve.
import { decimalsFor, duration, forceUnit, html, interval, number, significant, sentence, unitText } from "./common.js";
import { Points } from "./points.js";

/** Return factor and name of the unit in which a quantity is shown: mN for newtons, as everywhere on the page. */
const shownUnit = (unit) => (unit === "N" ? forceUnit({ force_unit: "N" }) : [1, unitText(unit)]);

/** Return a value with its unit, and its interval, as texts. */
export function textsOf({ value, low, high, unit }) {
  const [factor, name] = shownUnit(unit);
  if (low == null || high == null) return [`${significant(value * factor, 4)} ${name}`, ""];
  const half = (high - low) / 2 * factor;
  if (Math.abs(value * 2 - low - high) < 0.02 * (high - low)) {
    const [middle, error] = interval(value * factor, half);
    return [`${middle} ${name}`, error];
  }
  const shown = [value, low, high].map((x) => x * factor), least = Math.min(...shown.map(Math.abs).filter((x) => x > half / 1000));
  const decimals = half > 0 ? decimalsFor(Math.min(half, least), Math.max(...shown.map(Math.abs))) : 3;
  const [middle, ...ends] = shown.map((x) => number(x, decimals));
  return [`${middle} ${name}`, `[${ends.join(", ")}]`];
}

/** The best values with their intervals. */
export const Estimates = ({ estimates, title }) => html`<table class="result"><thead><tr><th>${title}</th><th class="right">value</th>
  <th class="right">95 % interval</th></tr></thead><tbody>${estimates.map((estimate) => {
  const [value, error] = textsOf({ unit: "1", ...estimate });
  return html`<tr><td>${estimate.name.replaceAll("_", " ")}</td><td class="right">${value}</td><td class="right">${error}</td></tr>`;
})}</tbody></table>`;

/** The curve of the results, once there are two. */
export function Growing({ points }) {
  if (!(points?.length > 1)) return null;
  const [factor, unit] = shownUnit(points[0].unit ?? "N");
  return html`<${Points} points=${points} factor=${factor} unit=${unit} />`;
}

/** Return how far a job is: its share, null if unknown, and the rest in words. */
export function shareOf({ progress, plan }, elapsed) {
  if (progress) {
    const { fraction, remaining } = progress;
    return [fraction, Number.isFinite(remaining) && fraction < 1 ? `about ${duration(remaining, true)} left` : ""];
  }
  const total = plan?.seconds;
  if (!total) return [null, ""];
  return elapsed > total ? [null, "soon at its end"] : [elapsed / total, `of about ${duration(total, true)}`];
}

/** What is known of an experiment while it runs. */
export function Progress({ job, elapsed }) {
  const [share] = shareOf(job, elapsed), { doing, estimates } = job.progress ?? {};
  return html`<progress key=${share === null} max=${share === null ? undefined : 1} value=${share ?? undefined} aria-label=${`Progress of ${job.kind}`}></progress>
    ${doing && html`<p class="muted">${sentence(doing)}</p>`}
    ${estimates?.length > 0 && html`<${Estimates} estimates=${estimates} title="until now" />`}`;
}
