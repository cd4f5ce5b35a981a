// The forms of experiments, made from the descriptions of the command line, and the check of what is entered.
import { call, html, useEffect, useRef, useState } from "./common.js";
import { defaultOf, Field } from "./fields.js";

/** Pause after an entry until the server is asked about it. */
const CHECK_MS = 200;
export const CHECK_TIMEOUT_MS = 60_000;

/** Return what a field of a form shows: what was entered, or its default. */
export const valueOf = (field, entered) => entered[field.name] ?? field.initial ?? defaultOf(field);

/** Return the fields of a form that are for the chosen kind of fish. */
export function fieldsOf(form, entered) {
  const chosen = form.fields.find(({ name }) => name === "on");
  const on = chosen && valueOf(chosen, entered);
  return form.fields.filter((field) => !field.on || field.on === on);
}

/** Return the entered values, without those that are the defaults of the command line. */
export const enteredOptions = (form, entered) => Object.fromEntries(fieldsOf(form, entered)
  .map((field) => [field.name, valueOf(field, entered), field.default])
  .filter(([, value, standard]) => value !== standard && value !== "" && value != null)
  .map(([name, value]) => [name, value]));

/** The fields of a form: the main ones, and the others when they are asked for. */
export function Fields({ form, entered, edit, disabled }) {
  const show = (field) => html`<${Field} key=${`${form.kind}.${field.name}`} prefix="option" isLive field=${field} value=${valueOf(field, entered)} edit=${edit} disabled=${disabled} />`;
  const fields = fieldsOf(form, entered), others = fields.filter(({ main }) => !main);
  return html`<div class="fields" role="group" aria-label="Options">${fields.filter(({ main }) => main).map(show)}</div>
    ${others.length > 0 && html`<details><summary>More options</summary><div class="fields">${others.map(show)}</div></details>`}`;
}

/** The parameters that are varied, each with its values or its range. */
export function Varied({ rows, names, isRange, set }) {
  const change = (index, more) => set(rows.map((row, place) => (place === index ? { ...row, ...more } : row)));
  const unused = names.find((name) => !rows.some((row) => row.name === name));
  return html`${rows.map(({ name, text }, index) => html`<div class="varied" key=${index}>
      <label class="row"><span>Parameter</span><select value=${name} onChange=${(event) => change(index, { name: event.target.value })}>
        ${names.map((word) => html`<option value=${word}>${word}</option>`)}</select></label>
      <label class="row"><span>${isRange ? "Range" : "Values"}</span><input value=${text} required autocomplete="off" spellcheck=${false}
        placeholder=${isRange ? "1:3, or : for all that is permitted" : "1:2:0.2 or 1,1.5,2"} onInput=${(event) => change(index, { text: event.target.value })} /></label>
      ${rows.length > 1 && html`<button type="button" aria-label=${`Do not vary ${name}`} onClick=${() => set(rows.filter((_, place) => place !== index))}>×</button>`}
    </div>`)}
    ${unused && html`<button type="button" class="link" onClick=${() => set([...rows, { name: unused, text: "" }])}>Vary another parameter</button>`}`;
}

/** Return the command line of a job, its plan, and what is wrong with it, as its verb says; one question at a time. */
export function useCheck(fish, kind, options, isReady) {
  const [answer, setAnswer] = useState({});
  const asks = useRef({ wanted: "", asked: "", isBusy: false }).current;
  const body = isReady ? JSON.stringify({ fish, kind, options }) : "";
  const ask = async () => {
    if (asks.isBusy || !asks.wanted || asks.wanted === asks.asked) return;
    Object.assign(asks, { asked: asks.wanted, isBusy: true });
    const sent = asks.asked;
    const checked = await call("POST", "/api/jobs/check", JSON.parse(sent), CHECK_TIMEOUT_MS).catch((error) => ({ command: [], problem: error.message }));
    asks.isBusy = false;
    setAnswer({ ...checked, kind: JSON.parse(sent).kind });
    ask();
  };
  useEffect(() => {
    asks.wanted = body;
    const timer = setTimeout(ask, CHECK_MS);
    return () => clearTimeout(timer);
  }, [body]);
  return isReady && answer.kind === kind ? answer : { command: [], problem: "", plan: null };
}
