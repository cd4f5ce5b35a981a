// The controller and its parameters, from their description; stop, tare, mark.
import { call, html, remember, useRef, useState } from "./common.js";
import { Field, missingOf, selectionOf, shownParameters } from "./fields.js";

const SEND_MS = 150;

export function Drive({ state, act, changed, changeRole, experiment, children }) {
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
    if (!running || isFile(name)) return;
    timer.current ||= setTimeout(sendEdited, SEND_MS);
  };
  const isFile = (name) => controller.parameters.some((field) => field.name === name && field.file);
  const sendEdited = async () => {
    const sent = Object.fromEntries(Object.entries(state.edited).filter(([name]) => !isFile(name)));
    if (await act("set-parameters", { parameters: sent })) Object.assign(state.applied, sent);
    // A refused value goes, too: what is shown then is what the fish does.
    for (const key in sent) if (state.edited[key] === sent[key]) delete state.edited[key];
    timer.current = Object.keys(state.edited).some((name) => !isFile(name)) ? setTimeout(sendEdited, SEND_MS) : 0;
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
  const missing = missingOf(controller, parameters);

  return html`
    <h2 id="drive-title" class="unseen">Controller</h2>
    ${!mayDrive && html`<p class="note">This device may only watch and use the E‑stop.</p>`}
    ${experiment && html`<p class="note">The experiment <b>${experiment.name}</b> (process ${experiment.pid}${experiment.host && ` on ${experiment.host}`})
      holds the fish.${mayDrive && " Stop ends it."}</p>`}
    ${children}
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
    <div class="buttons">
      <button type="button" id="start" class="primary" disabled=${!mayDrive || latched || missing.length > 0} onClick=${start}>
        ${running ? "Restart" : "Start"} ${controller.name}</button>
      <button type="button" id="stop" class="stop" disabled=${!mayDrive} onClick=${() => act("stop", {})}>Stop</button>
    </div>
    <p class="muted" aria-live="polite">${
      latched ? `Mode ${state.status.mode}: clear the fault before a start.`
      : missing.length ? `Needed first: ${missing.map(({ name }) => name).join(", ")}.`
      : running ? `Changes apply at once, from the next tick on${controller.parameters.some(({ file }) => file) ? "; another file at a restart" : ""}.`
      : "Changes apply at the start."}</p>
    <div class="fields" role="group" aria-label="Parameters">
      ${controller.parameters.map((field) => html`<${Field} key=${`${controller.name}.${field.name}`} field=${field}
        value=${parameters[field.name]} fish=${state.name} status=${state.status} edit=${edit} disabled=${!mayDrive} />`)}
    </div>
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
