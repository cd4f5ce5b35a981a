// The fields of a form that is made from descriptions: numbers with sliders, switches, choices, files and policies.
import { call, html, number, numberIn, recall, sentence, unitText, useEffect, useState } from "./common.js";

/** Return bounds and step of a slider, or null if the field is not a number between two bounds. */
export function sliderOf(field, status) {
  if (!["number", "integer"].includes(field.kind)) return null;
  let low = field.low ?? NaN, high = field.high ?? NaN;
  if (field.usual) [low, high] = [Math.max(low, -field.usual), Math.min(high, field.usual)];
  if (field.unit === "rad" && status) {
    [low, high] = [Math.max(low, -status.amplitude_limit), Math.min(high, status.amplitude_limit)];
  }
  if (!Number.isFinite(low) || !Number.isFinite(high) || low >= high) return null;
  const { step } = field;
  if (!step) return null;
  if (field.low_open && low === field.low) low += step;
  if (field.high_open && high === field.high) high -= step;
  return { low, high, step };
}

/** A text field that keeps what is being typed while the page is drawn again; with `isLive`, each key is an entry. */
export function Text({ value, commit, isLive, ...more }) {
  const [draft, setDraft] = useState(null);
  return html`<input autocomplete="off" spellcheck=${false} ...${more} value=${draft ?? value}
    onInput=${(event) => {
      setDraft(event.target.value);
      if (isLive) commit(event.target.value);
    }} onBlur=${() => setDraft(null)}
    onChange=${(event) => {
      commit(event.target.value);
      setDraft(null);
    }} />`;
}

const short = (value) => String(+value.toPrecision(3)).replace("-", "−");

/** A choice among words; one that is required and has no value yet is empty. */
const Choice = ({ value, options, pick, ...more }) => html`<select ...${more} value=${value ?? ""} onChange=${(event) => pick(event.target.value)}>
  ${(value ?? "") === "" && html`<option value="" disabled>choose</option>`}
  ${options.map(([word, text = word, isOff = false]) => html`<option value=${word} disabled=${isOff}>${text}</option>`)}</select>`;

const OTHER = "/", NONE = "/";
/** Return what the card of a policy says about its training, in a sentence. */
function cardText({ card, inputs }) {
  const { provenance, tick, amplitude } = card, { plant, relative_thrust: relative } = provenance;
  return [
    relative == null ? "relative thrust unknown" : `${number(100 * relative, 1)} % of the best square wave of its fish`,
    `trained on ${provenance.on === "robot" ? "a robot" : "simulated fish"}${plant.omega0 ? ` near ω₀ = ${short(plant.omega0)} rad/s, ξ = ${short(plant.xi)}` : ""}`,
    `from ${inputs}`, `tick ${short(1000 * tick)} ms`, `±${short(amplitude)} rad`, provenance.created.slice(0, 10), provenance.note,
  ].filter(Boolean).join("; ");
}

/** Return why a policy cannot swim this fish; empty if it can. */
const policyProblem = ({ problem, inputs }) => problem || (inputs.includes("pictures") ? "it needs a camera: run it with fishctl agent" : "");

/** The policies that fishd knows by name, with the card of the chosen one, or the path of another file. */
function Policy({ fish, value, commit, id, disabled, help }) {
  const [list, setList] = useState(null), [failure, setFailure] = useState(""), [isOther, setOther] = useState(false);
  useEffect(() => {
    call("GET", `/api/fish/${encodeURIComponent(fish)}/policies`).then(setList, (error) => {
      setFailure(error.message);
      setList([]);
    });
  }, [fish]);
  const chosen = list?.find(({ name }) => name === value), asks = isOther || (list && value && !chosen);
  const listed = list?.map((policy) => [policy.name, policy.name, Boolean(policyProblem(policy))]) ?? (value ? [[value]] : []);
  const options = [...listed, [OTHER, "another file …"]], refused = list?.filter(policyProblem) ?? [];
  return html`<div class="policy">
    <${Choice} id=${asks ? `${id}-list` : id} aria-label=${asks ? "Policy" : undefined} value=${asks ? OTHER : value} options=${options} disabled=${disabled} aria-describedby=${help}
      pick=${(name) => {
        setOther(name === OTHER);
        commit(name === OTHER ? "" : name);
      }} />
    ${asks && html`<${Text} id=${id} class="text" value=${value ?? ""} disabled=${disabled} placeholder="path on the fish's computer" commit=${commit} />`}
    ${chosen?.card && html`<small class="card-text">${sentence(cardText(chosen))}</small>`}
    ${refused.map((policy) => html`<small class="card-text">Not here: <b>${policy.name}</b>: ${sentence(policyProblem(policy))}</small>`)}
    ${failure && html`<small class="card-text">The policies cannot be listed. ${sentence(failure)}</small>`}</div>`;
}

/** The input of a value that is neither a switch nor a word of its own. */
function Value({ field, value, special, id, fish, disabled, status, send, isLive }) {
  const numeric = field.kind === "number" || field.kind === "integer", help = `${id}-help`;
  if (field.kind === "boolean" && value !== null) {
    return html`<input id=${id} type="checkbox" checked=${value} disabled=${disabled} aria-describedby=${help} onChange=${(event) => send(event.target.checked)} />`;
  }
  if (field.kind === "boolean") {
    return html`<${Choice} id=${id} value=${null} options=${[["yes"], ["no"]]} disabled=${disabled} aria-describedby=${help} pick=${(word) => send(word === "yes")} />`;
  }
  if (field.kind === "choice") {
    const options = [...(field.optional ? [[NONE, "default"]] : []), ...field.choices.map((word) => [word])];
    return html`<${Choice} id=${id} value=${field.optional ? value ?? NONE : value} options=${options} disabled=${disabled} aria-describedby=${help}
      pick=${(word) => send(word === NONE ? null : word)} />`;
  }
  if (field.file === ".onnx") return html`<${Policy} fish=${fish} value=${value} commit=${send} id=${id} disabled=${disabled} help=${help} />`;
  const shown = typeof value === "number" ? +value.toPrecision(6) : special === null ? value : "";
  return html`<${Text} id=${id} isLive=${isLive} class=${numeric ? "number" : "text"} inputmode=${numeric ? "decimal" : "text"} disabled=${disabled || special !== null} value=${shown ?? ""}
    placeholder=${special === "null" && field.unit === "rad" && status ? short(status.amplitude_limit) : field.file ? `path of a ${field.file} file` : ""}
    aria-describedby=${help} commit=${(text) => send(numeric ? numberIn(text) : text)} />`;
}

/** One parameter with its label, unit, bounds and description; `edit` gets its name and new value. */
export function Field({ field, value, disabled, fish, status, edit, prefix = "parameter", isLive }) {
  const id = `${prefix}-${field.name}`;
  const slider = sliderOf(field, status);
  const special = value === null && field.optional ? "null" : field.words?.includes(value) ? value : null;
  const specials = [...(field.optional && field.kind !== "choice" ? ["null"] : []), ...(field.words ?? [])];
  const fallback = typeof defaultOf(field) === "number" ? defaultOf(field) : slider?.high;
  const nullName = field.name === "amplitude" ? "limit" : "default";
  const send = (entered) => edit(field.name, entered);
  return html`<div class="field">
    <label for=${id}>${field.name.replaceAll("_", " ")}</label>
    <span class="value">
      ${specials.map((word) => html`<label class="special"><input type="checkbox" disabled=${disabled} checked=${special === word}
        onChange=${(event) => send(event.target.checked ? (word === "null" ? null : word) : fallback)} />
        ${word === "null" ? nullName : word}</label>`)}
      <${Value} ...${{ field, value, special, id, fish, disabled, status, send, isLive }} /><span class="unit">${unitText(field.unit)}</span>
    </span>
    ${slider && html`<span class="slide"><span>${short(slider.low)}</span><input type="range" aria-label=${`${field.name}, slider`} min=${slider.low} max=${slider.high}
      step=${slider.step} disabled=${disabled || special !== null} value=${special === null ? value ?? fallback : fallback}
      onInput=${(event) => send(Number(event.target.value))} /><span>${short(slider.high)}</span></span>`}
    <small id=${`${id}-help`}>${field.description.replace("null:", `${nullName}:`)}</small>
  </div>`;
}

/** Return the parameters of a controller that are required and have no value. */
export const missingOf = (controller, parameters) =>
  controller.parameters.filter((field) => field.required && (parameters[field.name] ?? "") === "");

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
