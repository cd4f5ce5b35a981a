// The kept runs: a table, and what is known of one, with its picture.
import { call, controllerText, duration, fetchPicture, forceUnit, html, interval, sentence, useEffect, useState } from "./common.js";
import { halfWidthOf, selectionWithOwn, startJob } from "./experiments.js";

const MAX_RUNS = 40;
/** Kinds of experiments that the server resumes. */
const RESUMABLE = ["measure", "sweep", "compare"];
const shortDate = new Intl.DateTimeFormat([], { month: "short", day: "numeric", hour: "2-digit", minute: "2-digit", hourCycle: "h23" });

export function Runs(page) {
  const { state } = page;
  const [runs, setRuns] = useState(null);
  const [failure, setFailure] = useState(null);
  const [open, setOpen] = useState(null);
  const finished = [...state.jobs.values()].filter(({ state: at }) => at !== "running").length;
  const load = () => call("GET", "/api/runs").then((found) => {
    setRuns(found);
    setFailure(null);
  }).catch(setFailure);
  useEffect(() => {
    if (state.session?.paired) load();
  }, [finished, state.session?.paired]);
  const begin = (run) => run.began ?? run.about?.started ?? "";
  const order = (run) => Number(run.number ?? run.about?.number ?? 0);
  const list = (runs ?? []).slice().sort((a, b) => order(b) - order(a)).slice(0, MAX_RUNS);
  return html`
    <div class="head-row"><h2 id="runs-title">Runs</h2><button type="button" onClick=${load}>Refresh</button></div>
    ${failure && html`<p class="note">The runs cannot be listed. ${sentence(failure.message)} ${sentence(failure.remedy)}</p>`}
    ${runs === null ? !failure && html`<p class="muted">Loading …</p>` : list.length === 0
      ? html`<p class="muted complete">None yet. Record, measure or sweep, and it is listed here.</p>`
      : html`<div class="scroll complete" tabindex="0" role="region" aria-label="Table of runs"><table>
        <thead><tr><th>name</th><th>what</th><th>began</th><th class="right">length</th><th class="right">thrust</th>
          <th class="right">lost ticks</th><th><span class="unseen">what to do</span></th></tr></thead>
        <tbody>${list.map((run) => {
          const [factor, unit] = forceUnit(run);
          const half = halfWidthOf(run);
          const [middle, error] = run.thrust == null ? ["", ""] : interval(run.thrust * factor, half == null ? NaN : half * factor);
          return html`<tr key=${run.name} class=${run.kind === "recording" && run.problem ? "damaged" : ""}>
            <td>${run.name}
              ${["running", "recording", "unfinished"].includes(run.state) && html` <span class="pill small">${run.state}</span>`}
              ${run.problem && html`<br /><small>${run.problem}</small>`}</td><td>${run.kind === "recording" ? Object.keys(run.swim_ticks ?? {}).join(", ") || "at rest" : run.kind}</td><td>${begin(run) && shortDate.format(new Date(begin(run)))}</td>
            <td class="right">${run.duration !== undefined ? duration(run.duration) : run.kind === "sweep" && run.rows ? `${run.rows} points` : ""}</td>
            <td class="right">${middle} ${error} ${run.thrust == null ? "" : unit}</td>
            <td class="right">${run.lost_ticks ?? ""}</td>
            <td class="actions">
              <button type="button" aria-expanded=${open === run.name} aria-label=${`${open === run.name ? "Close" : "Open"} ${run.name}`}
                onClick=${() => setOpen(open === run.name ? null : run.name)}>${open === run.name ? "Close" : "Open"}</button>
            </td></tr>
            ${open === run.name && html`<tr class="plot-row"><td colspan="7"><${Run} key=${run.name} run=${run} page=${page} /></td></tr>`}`;
        })}</tbody></table></div>`}`;
}

/** What is known of a run, what can be done with it, and its picture. */
function Run({ run, page }) {
  const { state } = page;
  const { controller, own } = selectionWithOwn(state);
  const mayDrive = state.session?.scope === "drive";
  const { subject, note, operator } = run.about ?? {};
  const about = [run.summary, subject, note, operator && `by ${operator}`].filter(Boolean).join("; ");
  const rerun = (options) => () => startJob(page, "rerun", { run: run.name, ...options });
  const resumable = run.state === "unfinished" && run.on === "live" && RESUMABLE.includes(run.kind);
  return html`
    ${about && html`<p>${about}</p>`}
    ${run.command?.length > 0 && html`<p><code>${["fishctl", run.kind, ...run.command].join(" ")}</code></p>`}
    <p class="muted">${run.path}</p>
    ${run.kind === "recording" && html`<div class="buttons">
      <button type="button" disabled=${!mayDrive} onClick=${rerun({})}>Rerun as recorded</button>
      ${controller && html`<button type="button" disabled=${!mayDrive} onClick=${rerun({ controller: controller.name, parameters: own })}>
        Rerun with ${controllerText(controller.name, own)}</button>`}
      <span class="muted">Runs a controller again on the recorded forces, and compares its commands. The fish rests.</span></div>`}
    ${resumable && html`<div class="buttons"><button type="button" class="primary" disabled=${!mayDrive}
      onClick=${() => startJob(page, "resume", { run: run.name })}>Resume</button>
      <span class="muted">It ended before it was complete; nothing is measured again.</span></div>`}
    ${run.state !== "running" && html`<${Plot} name=${run.name} />`}`;
}

function Plot({ name }) {
  const [picture, setPicture] = useState(null);
  const [failure, setFailure] = useState("");
  useEffect(() => {
    let address = null;
    fetchPicture(`/api/runs/${encodeURIComponent(name)}/plot.png`).then((blob) => {
      address = URL.createObjectURL(blob);
      setPicture(address);
    }, (error) => setFailure(error.message));
    return () => address && URL.revokeObjectURL(address);
  }, []);
  if (failure) return html`<p class="note">${sentence(failure)}</p>`;
  return picture ? html`<img alt=${`Plot of ${name}`} src=${picture} />` : html`<p class="muted">It is being drawn …</p>`;
}
