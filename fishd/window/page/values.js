// The present values as cards: what the fish does, and how well its loop runs.
import { forceUnit, html, interval, number, sentence, significant, unitText } from "./common.js";

function Card({ title, value, extra = "", unit = "", note = "", level = "", children }) {
  return html`<div class=${`card ${level}`}><h3>${title}</h3>
    <p class="big"><span>${value}</span> <small>${extra} ${unit}</small></p><p class="sub">${note && html`<span>${note}</span>`}${children}</p></div>`;
}

/** Return the largest value of a column in the last second. */
function largest(ring, name) {
  const recent = new Array(Math.max(1, Math.ceil(1 / ring.period))).fill(null);
  ring.copy(name, recent);
  return recent.reduce((most, value) => (value !== null && !(value <= most) ? value : most), NaN);
}

/** Return thrust and half-width of its interval as texts, and their unit. */
export function thrustTexts({ tick, status }) {
  const [factor, unit] = forceUnit(status), half = tick?.thrust_ci95;
  return [...interval(tick?.thrust * factor, half == null ? NaN : half * factor), unit];
}

export function Values({ state, ring, ownText, setReference }) {
  const { tick, status, reference } = state;
  const half = tick?.thrust_ci95;
  const [thrust, error, unit] = thrustTexts(state);
  const ratio = reference ? tick?.thrust / reference.thrust : NaN;
  const ratioHalf = Math.abs(ratio) * Math.hypot((half ?? NaN) / tick?.thrust, (reference?.half ?? NaN) / reference?.thrust);
  const [relative, relativeError] = interval(100 * ratio, 100 * ratioHalf);
  return html`
    <${Card} title="Thrust" value=${thrust} extra=${error} unit=${unit}
      note=${!tick ? "" : half == null ? "mean F_x: the zero is unknown" : tick.mode === "running" ? "mean of whole beats" : "at rest"} />
    <${Card} title="Tail beat" value=${tick?.frequency ? number(tick.frequency, 2) : "–"} unit=${tick?.frequency ? "Hz" : ""} note=${tick?.frequency ? `${number(60 * tick.frequency, 0)} a minute` : tick && "no beats"} />
    ${tick?.speed !== undefined && html`<${Card} title="Speed" value=${number(1000 * tick.speed, 1)} unit="mm/s" note="true speed of the simulated fish" />`}
    <${Card} title="Relative thrust" value=${relative} extra=${relativeError} unit=${reference ? "%" : ""} note=${reference?.text ?? ""}>
      <button type="button" class="link" disabled=${!tick} onClick=${setReference}>${reference ? "again" : "take this as 100 %"}</button><//>
    ${Object.entries(status?.readings ?? {}).map(([name, reading]) => html`<${Card} key=${name} title=${sentence(name.replaceAll("_", " ")).slice(0, -1)}
      value=${significant(reading.value ?? NaN, 4)} unit=${reading.value == null ? "" : unitText(reading.unit)}
      level=${reading.problem ? "warn" : ""} note=${reading.problem ?? "mean of 2 s"} />`)}
    <${Card} title="Controller" value=${status ? (status.mode === "running" ? status.controller : "none") : "–"}
      note=${status ? (status.mode === "running" ? ownText(status.controller, status.parameters) || "default parameters" : status.servo_on ? "servo at neutral" : "servo without pulses") : ""} />
    <${Health} state=${state} ring=${ring} onlyBad />`;
}

/** How well sensor, loop and stream run; `onlyBad`: only what is doubtful. */
export function Health({ state, ring, onlyBad = false }) {
  const { tick, status } = state;
  const age = largest(ring, "sample_age_ms"), late = largest(ring, "lateness_us") / 1000, period = ring.period * 1000;
  return [
    { title: "Sensor age", value: number(age, 1), unit: "ms", isBad: age > 2 * period, note: tick?.suspect ? `suspect: ${tick.suspect}` : "largest of 1 s" },
    { title: "Tick lateness", value: number(late, 2), unit: "ms", isBad: late > 0.5 * period,
      note: status && `${status.overruns} overruns, ${status.missed_slots} missed` },
    { title: "Tick", value: tick ? `#${tick.seq}` : "–", isBad: ring.lost > 0,
      note: ring.lost ? `${ring.lost} lost on the way in 2 min` : tick && "none lost in 2 min" },
  ].filter(({ isBad }) => isBad || !onlyBad).map((card) => html`<${Card} key=${card.title} ...${card} level=${card.isBad ? "warn" : ""} />`);
}
