// The controller and its parameters, from their description; stop, tare, mark.
import { call, html, numberIn, parametersText, recall, remember, unitText, useRef, useState } from "./common.js";

const SEND_MS = 150;
const STEPS = 200;

/** Return bounds and step of a slider, or null if the field is not a number between two bounds. */
export function sliderOf(field, status) {
  if (!["number", "integer"].includes(field.kind)) return null;
  let low = field.low ?? NaN, high = field.high ?? NaN;
  if (field.usual) [low, high] = [Math.max(low, -field.usual), Math.min(high, field.usual)];
  if (field.unit === "rad" && status) {
    [low, high] = [Math.max(low, -status.amplitude_limit), Math.min(high, status.amplitude_limit)];
  }
  if (!Number.isFinite(low) || !Number.isFinite(high) || low >= high) return null;
  const rough = (high - low) / STEPS, power = 10 ** Math.floor(Math.log10(rough));
  let step = [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999) * power;
  if (field.kind === "integer") step = Math.max(1, Math.round(step));
  if (field.low_open && low === field.low) low += step;
  if (field.high_open && high === field.high) high -= step;
  return { low, high, step };
}

/** Return the value in a text field, as the field's kind. */
function valueOf(field, text) {
  return ["boolean", "text", "choice"].includes(field.kind) ? text : numberIn(text);
}

/** A text field that keeps what is being typed while the page is drawn again. */
function Text({ value, commit, ...more }) {
  const [draft, setDraft] = useState(null);
  return html`<input autocomplete="off" spellcheck=${false} ...${more} value=${draft ?? value}
    onInput=${(event) => setDraft(event.target.value)} onBlur=${() => setDraft(null)}
    onChange=${(event) => {
      commit(event.target.value);
      setDraft(null);
    }} />`;
}

const short = (value) => String(+value.toPrecision(3)).replace("-", "−");

function Field({ field, value, disabled, status, edit }) {
  const id = `parameter-${field.name}`;
  const slider = sliderOf(field, status);
  const special = value === null && field.optional ? "null" : field.words?.includes(value) ? value : null;
  const specials = [...(field.optional ? ["null"] : []), ...(field.words ?? [])];
  const shown = typeof value === "number" ? +value.toPrecision(6) : special === null ? value : "";
  const fallback = typeof defaultOf(field) === "number" ? defaultOf(field) : slider?.high;
  const nullName = field.name === "amplitude" ? "limit" : "default";
  const numeric = field.kind === "number" || field.kind === "integer";
  const send = (text) => edit(field.name, valueOf(field, text));
  let input;
  if (field.kind === "boolean") {
    input = html`<input id=${id} type="checkbox" checked=${value} disabled=${disabled}
      onChange=${(event) => edit(field.name, event.target.checked)} />`;
  } else if (field.kind === "choice") {
    input = html`<select id=${id} disabled=${disabled} value=${value} onChange=${(event) => send(event.target.value)}>
      ${field.choices.map((word) => html`<option value=${word}>${word}</option>`)}
    </select>`;
  } else {
    input = html`<${Text} id=${id} class=${numeric ? "number" : "text"} inputmode=${numeric ? "decimal" : "text"}
      disabled=${disabled || special !== null} value=${shown ?? ""}
      placeholder=${special === "null" && field.unit === "rad" && status ? short(status.amplitude_limit) : ""} aria-describedby=${`${id}-help`} commit=${send} />`;
  }
  return html`<div class="field">
    <label for=${id}>${field.name.replaceAll("_", " ")}</label>
    <span class="value">
      ${specials.map((word) => html`<label class="special"><input type="checkbox" disabled=${disabled}
        checked=${special === word}
        onChange=${(event) => edit(field.name, event.target.checked ? (word === "null" ? null : word) : fallback)} />
        ${word === "null" ? nullName : word}</label>`)}
      ${input}<span class="unit">${unitText(field.unit)}</span>
    </span>
    ${slider && html`<input type="range" class="slider" aria-label=${`${field.name}, slider`} min=${slider.low} max=${slider.high}
      step=${slider.step} disabled=${disabled || special !== null} value=${special === null ? value ?? fallback : fallback}
      onInput=${(event) => edit(field.name, Number(event.target.value))} />
      <span class="bounds"><span>${short(slider.low)}</span><span>${short(slider.high)}</span></span>`}
    <small id=${`${id}-help`}>${field.description.replace("null:", `${nullName}:`)}</small>
  </div>`;
}

/** Return the parameters that the panel shows: what was edited, else the active ones, those of the latest start, or the defaults. */
export function shownParameters(controller, status, edited, applied) {
  const active = status?.mode === "running" && status.controller === controller.name ? status.parameters : {};
  return Object.fromEntries(controller.parameters.map((field) => [
    field.name, field.name in edited ? edited[field.name]
      : field.name in active ? active[field.name] : field.name in applied ? applied[field.name] : defaultOf(field),
  ]));
}

/** Return the default of a parameter; one that is zero, false or empty is left out of the description. */
export const defaultOf = (field) =>
  "default" in field ? field.default : ({ number: 0, integer: 0, boolean: false, text: "" }[field.kind] ?? null);

/** Return the description of the selected controller, what was edited of it, and what this page has applied. */
export function selectionOf(state) {
  const kept = recall(`selection.${state.name}`, {});
  const running = state.status?.mode === "running" ? state.status.controller : null;
  const names = state.controllers.map(({ name }) => name);
  const name = [state.selected, kept.name, running, "swing", names[0]].find((candidate) => names.includes(candidate));
  const controller = state.controllers.find((candidate) => candidate.name === name);
  if (!state.edited || state.editedOf !== name) {
    state.edited = kept.name === name ? (kept.edited ?? {}) : {};
    state.applied = kept.name === name ? (kept.applied ?? {}) : {};
    state.editedOf = name;
  }
  return { controller, edited: state.edited, applied: state.applied, running: running === name };
}

export function Drive({ state, act, changed, changeRole, experiment }) {
  const timer = useRef(0);
  const [text, setText] = useState("");
  const { controller, edited, applied, running } = selectionOf(state);
  if (!controller) return html`<h2 id="drive-title">Controller</h2><p class="muted">No fishd has answered yet.</p>`;
  const parameters = shownParameters(controller, state.status, edited, applied);
  const keep = () => remember(`selection.${state.name}`, { name: controller.name, edited: state.edited, applied: state.applied });
  const mayDrive = state.session?.scope === "drive";
  const latched = ["fault", "estop"].includes(state.status?.mode);
  const other = state.driver && !state.driver.you_drive;

  const select = (name) => {
    Object.assign(state, { selected: name, edited: {}, applied: {}, editedOf: name });
    remember(`selection.${state.name}`, { name, edited: {} });
    changed();
  };
  const edit = (name, value) => {
    state.edited[name] = value;
    keep();
    changed();
    const field = controller.parameters.find((candidate) => candidate.name === name);
    if (!running || field.file) return;
    timer.current ||= setTimeout(sendEdited, SEND_MS);
  };
  const sendEdited = async () => {
    const sent = { ...state.edited };
    if (await act("set-parameters", { parameters: sent })) Object.assign(state.applied, sent);
    // A refused value goes, too: what is shown then is what the fish does.
    for (const key in sent) if (state.edited[key] === sent[key]) delete state.edited[key];
    timer.current = Object.keys(state.edited).length ? setTimeout(sendEdited, SEND_MS) : 0;
    keep();
    changed();
  };
  const start = async () => {
    if (await act("set-controller", { name: controller.name, parameters })) {
      Object.assign(state, { edited: {}, applied: parameters });
      keep();
      changed();
    }
  };
  const missing = controller.parameters.filter((field) => field.required && (parameters[field.name] ?? "") === "");

  return html`
    <h2 id="drive-title">Controller</h2>
    ${!mayDrive && html`<p class="note">This device may only watch and use the E‑stop.</p>`}
    ${experiment && html`<p class="note">The experiment <b>${experiment.name}</b> (process ${experiment.pid}${experiment.host && ` on ${experiment.host}`})
      holds the fish. Stop ends it.</p>`}
    ${mayDrive && html`<div class="role">
      <span>${other ? html`<b>${driverName(state).replace(/^another page$/, "Another page")}</b> drives` : state.driver ? "You drive" : "No page drives"}</span>
      ${state.driver?.you_drive
        ? html`<button type="button" onClick=${() => changeRole(false)}>Release</button>`
        : html`<button type="button" onClick=${() => changeRole(true, Boolean(other))}>
            ${other ? "Take over" : "Drive"}</button>`}
      <label class="special"><input type="checkbox" checked=${state.keep} disabled=${other}
        onChange=${(event) => {
          state.keep = event.target.checked;
          remember("keep", state.keep);
          if (state.driver?.you_drive) changeRole(true, false);
          changed();
        }} /> keep swimming when I leave</label>
    </div>`}
    <label class="row" for="controller"><span>Controller</span>
      <select id="controller" value=${controller.name} onChange=${(event) => select(event.target.value)}>
        ${state.controllers.map(({ name }) => html`<option value=${name}>${name}</option>`)}
      </select></label>
    <p class="summary">${controller.summary}</p>
    <div class="fields">
      ${controller.parameters.map((field) => html`<${Field} key=${`${controller.name}.${field.name}`} field=${field}
        value=${parameters[field.name]} status=${state.status} edit=${edit}
        disabled=${!mayDrive || (running && field.file)} />`)}
    </div>
    <div class="buttons">
      <button type="button" id="start" class="primary" disabled=${!mayDrive || latched || missing.length > 0} onClick=${start}>
        ${running ? "Restart" : "Start"} ${controller.name}</button>
      <button type="button" id="stop" class="stop" disabled=${!mayDrive} onClick=${() => act("stop", {})}>Stop</button>
    </div>
    <p class="muted" aria-live="polite">${
      latched ? `Mode ${state.status.mode}: clear the fault before a start.`
      : missing.length ? `Needed first: ${missing.map(({ name }) => name).join(", ")}.`
      : running ? "Changes apply at once, from the next tick on."
      : "Changes apply at the start."}</p>
    <div class="tools">
      <button type="button" id="tare" disabled=${!mayDrive} title="Takes the present force as zero; the fish must be still."
        onClick=${() => act("tare", {})}>Tare</button>
      <form onSubmit=${async (event) => {
        event.preventDefault();
        if (await act("mark", { text: text || "mark" })) setText("");
      }}>
        <input id="mark" aria-label="Text of the mark" placeholder="text of a mark" maxlength="200" disabled=${!mayDrive}
          autocomplete="off" value=${text} onInput=${(event) => setText(event.target.value)} />
        <button disabled=${!mayDrive}>Mark</button>
      </form>
    </div>`;
}

/** Return the name of the device that drives; another page of the same device has no name of its own. */
export const driverName = ({ driver, session }) =>
  (driver.device && driver.device !== session?.device ? driver.device : "another page");

/** Send a request for a fish; used by all buttons. */
export const request = (fish, path, body) => call("POST", `/api/fish/${encodeURIComponent(fish)}/${path}`, body);
