// One kept run: its note and name, its results, its rows and its picture, and what can be done with it.
import { call, Command, controllerText, html, sentence, useState } from "./common.js";
import { selectionWithOwn, startJob } from "./experiments.js";
import { Picture, Results, useResults } from "./results.js";
import { Rows } from "./rows.js";

/** Return the name of the file or folder of a run, by which the server knows it. */
export const idOf = (run) => run.path.split("/").at(-1);
export const isInProgress = (run) => ["running", "recording"].includes(run.state);
const pathOf = (id) => `/api/runs/${encodeURIComponent(id)}`;

/** changed: reads the runs again; open: opens the run of an identifier, or none */
export function Run({ run, page, changed, open }) {
  const { state, notice } = page, id = idOf(run);
  const mayDrive = state.session?.scope === "drive", isBusy = isInProgress(run);
  const { controller, own } = selectionWithOwn(state);
  const [found, failure] = useResults([id]);
  const about = [run.about?.subject, run.about?.operator && `by ${run.about.operator}`, run.problem].filter(Boolean).join("; ");
  const rerun = (options) => () => startJob(page, "rerun", { run: id, ...options });
  const resumable = run.state === "unfinished" && state.forms?.some((form) => form.is_experiment && form.words.join(" ") === run.kind);
  const ask = (what, body) => call("POST", `${pathOf(id)}/${what}`, body).then((result) => {
    changed();
    return result;
  }, (error) => notice("error", error.message, error.remedy));
  const rename = async (name) => {
    const [path] = await ask("rename", { name }) ?? [];
    if (path) open(path.split("/").at(-1));
  };
  const remove = async () => {
    const [deleted] = await ask("delete") ?? [];
    if (!deleted) return;
    open(null);
    notice("warning", `deleted ${run.name}, which stays in the trash for 30 days`, "", ["Undo", () => restore(page, deleted, changed)]);
  };
  return html`
    ${about && html`<p>${about}</p>`}
    ${run.command?.length > 0 && html`<${Command} words=${["fishctl", ...run.kind.split(" "), ...run.command]} />`}
    <p class="muted">${run.path}</p>
    <div class="edits">
      <${Edit} label="Note" value=${run.about?.note ?? ""} verb="Save" isOff=${!mayDrive} send=${(note) => ask("note", { note })} />
      <${Edit} label="Name" value=${run.name} verb="Rename" isOff=${!mayDrive || isBusy} isNeeded send=${rename} />
      <button type="button" class="stop" disabled=${!mayDrive || isBusy} onClick=${remove}>Delete</button>
      ${isBusy && html`<span class="muted">It is in progress: it can be renamed and deleted after its end.</span>`}
    </div>
    <div class="buttons downloads">Download
      ${Object.entries(downloadsOf(run)).map(([title, path]) => html`<a download=${`${run.name}.png`} href=${pathOf(id) + path}>${title}</a>`)}</div>
    ${run.kind === "recording" && html`<div class="buttons">
      <button type="button" disabled=${!mayDrive} onClick=${rerun({})}>Rerun as recorded</button>
      ${controller && html`<button type="button" disabled=${!mayDrive} onClick=${rerun({ controller: controller.name, parameters: own })}>
        Rerun with ${controllerText(controller.name, own)}</button>`}
      <span class="muted">Runs a controller again on the recorded forces, and compares its commands. The fish rests.</span></div>`}
    ${resumable && html`<div class="buttons"><button type="button" class="primary" disabled=${!mayDrive}
      onClick=${() => startJob(page, "resume", { run: id, on: run.on })}>Resume</button>
      <span class="muted">It ended before it was complete; nothing is measured again.</span></div>`}
    ${failure && html`<p class="note">${sentence(failure)}</p>`}
    ${found && html`<${Results} results=${found} />`}
    ${Object.keys(found?.[0].columns ?? {}).length > 1 && html`<${Rows} result=${found[0]} />`}
    ${!isBusy && html`<${Picture} path=${`${pathOf(id)}/plot.png`} title=${run.name} />`}`;
}

/** Move a run back from the trash. */
export function restore({ notice }, { id, name }, changed) {
  return call("POST", `/api/trash/${id}/restore`).then(() => notice("info", `restored ${name}`),
    (error) => notice("error", error.message, error.remedy)).then(changed);
}

/** Return what can be downloaded of a run: paths below its own, by their titles. */
function downloadsOf(run) {
  const file = (name) => `/download/${name}`;
  const own = run.kind === "recording"
    ? { MCAP: file("recording.mcap"), CSV: file("ticks.csv"), "Events (CSV)": file("events.csv"), Parquet: file("ticks.parquet") }
    : run.rows ? { "Rows (CSV)": file("rows.csv") } : {};
  return { ...own, ...(isInProgress(run) ? {} : { Picture: "/plot.png" }), "All (zip)": file("all.zip") };
}

/** A text that is sent when it has changed. */
function Edit({ label, value, verb, isOff, isNeeded, send }) {
  const [typed, setTyped] = useState(null), shown = typed ?? value;
  const submit = async (event) => {
    event.preventDefault();
    await send(shown.trim());
    setTyped(null);
  };
  return html`<form class="edit" onSubmit=${submit}><label>${label}
    <input value=${shown} disabled=${isOff} required=${isNeeded} maxlength=${isNeeded ? 100 : 1000} autocomplete="off"
      onInput=${(event) => setTyped(event.target.value)} /></label>
    <button disabled=${isOff || shown.trim() === value}>${verb}</button></form>`;
}
