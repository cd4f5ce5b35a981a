// Experiments as child processes of the server: a form, and the jobs with the command line that each ran.
import { call, Command, controllerText, duration, forceUnit, html, interval, number, recall, remember, sentence, useEffect, useState } from "./common.js";
import { Curve } from "./curve.js";
import { defaultOf, missingOf, selectionOf, shownParameters } from "./fields.js";
import { CHECK_TIMEOUT_MS, enteredOptions, Fields, fieldsOf, useCheck, valueOf, Varied } from "./forms.js";
import { AddToQueue, Queue } from "./queue.js";
import { Estimates, Growing, Progress, shareOf } from "./progress.js";

/** Start a job; take the driver's role first where it needs it. Say why it was refused, and offer to take the fish. */
export async function startJob({ state, notice, changed, becomeDriver }, kind, options, take = false) {
  const isExperiment = state.forms?.find((form) => form.kind === kind)?.is_experiment && !options.recordings?.length;
  const drives = kind === "queue" || (kind === "resume" ? options.on !== "simulation" : isExperiment && options.on !== "simulation");
  try {
    if (drives && (take || !state.driver?.you_drive)) await becomeDriver(take);
    const { on, ...others } = options, sent = kind === "resume" ? others : options, more = drives && take ? { take } : {};
    const job = await call("POST", "/api/jobs", { fish: state.name, kind, options: { ...sent, ...more } }, CHECK_TIMEOUT_MS);
    state.jobs.set(job.id, job);
    changed();
  } catch (error) {
    const remedies = { driven: "Take over", "not-driver": "Take over", leased: "Take the fish" };
    notice("error", error.message, error.remedy, remedies[error.code] && [remedies[error.code], () => startJob({ state, notice, changed, becomeDriver }, kind, options, true)]);
  }
}

/** Return the title of a kind of job, which is that of its form. */
export const titleOf = ({ forms }, kind) => forms?.find((form) => form.kind === kind)?.title ?? kind;

/** Return the half-width of a thrust's interval, with the calibration where that is known. */
export const halfWidthOf = ({ thrust_ci95: statistical, total_ci95: total }) => total ?? statistical;

/** Return the thrust of the newest simulated fish among the jobs [N]; null without one, or where the true force is in another unit. */
export function triedThrust({ jobs, status }) {
  const tried = [...jobs.values()].filter(({ kind, state }) => kind === "simulate" && state === "done").at(-1)?.result.mean_thrust;
  return Number.isFinite(tried) && forceUnit(status)[1] === "mN" ? tried : null;
}

/** Return the selected controller with those of its parameters that are not the defaults. */
export function selectionWithOwn(state) {
  const { controller, edited, applied } = selectionOf(state);
  const own = Object.entries(controller ? shownParameters(controller, state.status, edited, applied) : {}).filter(([name, value]) => {
    const field = controller.parameters.find((candidate) => candidate.name === name);
    return value !== null && value !== defaultOf(field);
  });
  const missing = controller ? missingOf(controller, shownParameters(controller, state.status, edited, applied)) : [];
  return { controller, own: Object.fromEntries(own), missing };
}

/** Kind of experiment, and what was entered for each: the fields of the command line, and the arguments before them. */
const NOTHING = { kind: "measure", entered: {}, words: { contestants: "square swing" }, varied: [{ name: "", text: "" }] };

export function Experiments(page) {
  const { state, notice } = page;
  const [entry, setEntry] = useState(() => recall("forms", NOTHING));
  const [failure, setFailure] = useState("");
  const paired = Boolean(state.session?.paired);
  const load = () => call("GET", "/api/forms").then((forms) => {
    Object.assign(state, { forms });
    setFailure("");
    page.changed();
  }, (error) => setFailure(error.message));
  useEffect(() => {
    if (paired && !state.forms) load();
  }, [paired]);
  const set = (more) => {
    const next = { ...entry, ...more };
    remember("forms", next);
    setEntry(next);
  };
  const forms = (state.forms ?? []).filter(({ kind }) => kind !== "rerun");
  const form = forms.find(({ kind }) => kind === entry.kind) ?? forms[0];
  if (!form) {
    return html`<h2 id="experiments-title">Experiments</h2>${failure ? html`<p class="note">The forms cannot be read. ${sentence(failure)}</p>
      <button type="button" onClick=${load}>Try again</button>` : html`<p class="muted">Loading …</p>`}`;
  }
  return html`<h2 id="experiments-title">Experiments</h2>
    <div class="tabs" role="tablist" aria-label="Kind of experiment">
      ${forms.map(({ kind, title }) => html`<button type="button" role="tab" id=${`tab-${kind}`}
        aria-selected=${form.kind === kind} aria-controls="experiment" onClick=${() => set({ kind })}>${title}</button>`)}
    </div>
    <${Experiment} key=${form.kind} ...${{ page, form, entry, set }} />
    <${Queue} page=${page} />
    <ul class="jobs" aria-label="Started experiments">
      ${[...state.jobs.values()].filter(({ fish, kind }) => kind !== "queue" && (!fish || fish === state.name)).sort((a, b) => b.id - a.id).slice(0, 8)
        .map((job) => html`<${Job} key=${job.id} job=${job} state=${state} notice=${notice} mayDrive=${state.session?.scope === "drive"}
        resume=${() => startJob(page, "resume", { run: job.run, on: job.command.join(" ").includes("--on simulation") ? "simulation" : "live" })} />`)}
    </ul>`;
}

/** Return the arguments of an experiment, as the server takes them. */
function argumentsOf(form, { words, varied }, controller, own) {
  const list = (words[form.argument] ?? "").split(/[\s]+/).filter(Boolean);
  switch (form.argument) {
    case "controller": return { controller: controller?.name, parameters: form.values === "one" ? own
      : { ...own, ...Object.fromEntries(varied.map(({ name, text }) => [name, text.trim()])) } };
    case "contestants": case "recordings": return { [form.argument]: list };
    case "name": return list.length ? { name: words.name.trim() } : {};
    default: return {};
  }
}

/** One form, its preview, and its buttons. */
function Experiment({ page, form, entry, set }) {
  const { state } = page, { kind } = form;
  const { controller, own, missing } = selectionWithOwn(state);
  const entered = entry.entered[kind] ?? {}, words = entry.words;
  const edit = (name, value) => set({ entered: { ...entry.entered, [kind]: { ...entered, [name]: value } } });
  const say = (text) => set({ words: { ...words, [form.argument]: text } });
  const mayDrive = state.session?.scope === "drive", uses = form.argument === "controller";
  const varies = uses && form.values !== "one", isRange = form.values === "range";
  const names = (controller?.parameters ?? []).filter((field) => !isRange || field.kind === "number").map(({ name }) => name);
  const kept = entry.varied.filter(({ name }) => names.includes(name));
  const varied = varies ? (kept.length ? kept : [{ name: names[0], text: isRange ? ":" : "" }]) : [];
  const hasNothing = varies && controller && names.length === 0;
  const needed = uses ? missing.filter(({ name }) => !varied.some((row) => row.name === name)) : [];
  const isComplete = !uses || (controller && !hasNothing && needed.length === 0 && varied.every(({ text }) => text.trim()));
  const isReady = Boolean(isComplete && !form.problem && state.session?.paired);
  const options = isReady ? { ...argumentsOf(form, { words, varied }, controller, own), ...enteredOptions(form, entered) } : {};
  const { command, problem, plan } = useCheck(state.name, kind, options, isReady);
  const start = (event) => {
    event.preventDefault();
    startJob(page, kind, options);
  };
  const text = (label, placeholder) => html`<label class="row"><span>${label}</span><input value=${words[form.argument] ?? ""} autocomplete="off"
    spellcheck=${false} placeholder=${placeholder} onInput=${(event) => say(event.target.value)} /></label>`;
  return html`<form id="experiment" role="tabpanel" aria-labelledby=${`tab-${kind}`} onSubmit=${start}>
      <p class="summary">${form.about}</p>
      ${form.problem && html`<p class="note">Not on this machine: ${form.problem}.</p>`}
      ${uses && controller && html`<p class="with">With <b>${controllerText(controller.name, own)}</b><span class="muted">, as in the panel Controller</span></p>`}
      <div class="form">
        ${varies && !hasNothing && html`<${Varied} rows=${varied} names=${names} isRange=${isRange} set=${(rows) => set({ varied: rows })} />`}
        ${form.argument === "contestants" && text("Contestants", "best square wave, swing, policies of this fish")}
        ${form.argument === "recordings" && text("Recordings", "none: first swim an excitation")}
        ${form.argument === "name" && text("Name", "date and time")}
      </div>
      <${Fields} form=${form} entered=${entered} edit=${edit} disabled=${Boolean(form.problem)} />
      <div id="preview" aria-live="polite">
        ${hasNothing ? html`<p class="muted">${controller.name} has no ${isRange ? "number to search" : "parameter to vary"}: choose another controller.</p>`
          : needed.length ? html`<p class="muted">Needed first, in the panel Controller: ${needed.map(({ name }) => name).join(", ")}.</p>`
          : isReady && problem ? html`<p class="note">${sentence(problem)}</p>`
            : isReady && command.length > 0 && html`<${Command} words=${command} label="Command line to come" />
              ${plan && html`<p class="muted">${planText(plan, form, entered)}</p>`}`}
      </div>
      <div class="buttons">
        <button class="primary" disabled=${!mayDrive || !isReady || problem !== ""}>${kind === "simulate" ? "Try on a simulated fish" : form.title}</button>
        ${form.is_experiment && !options.recordings?.length && html`<${AddToQueue} ...${{ page, kind, options }} disabled=${!mayDrive || !isReady || problem !== ""} />`}
        ${form.argument === "contestants" && controller && html`<button type="button"
          onClick=${() => say(`${(words.contestants ?? "").trim()} ${controllerText(controller.name, own)}`.trim())}>Add ${controller.name}</button>`}
      </div>
    </form>`;
}

/** Return how long an experiment takes, as its verb says. */
function planText({ amount, unit, seconds }, form, entered) {
  const takes = `Takes ${form.fields.some(({ name }) => name === "budget") ? "at most" : "about"}`;
  if (seconds !== null) return `${takes} ${duration(seconds, true)}.`;
  const isVirtual = fieldsOf(form, entered).some((field) => field.name === "on" && valueOf(field, entered) === "simulation");
  return `${takes} ${+amount.toFixed(1)} ${unit}${isVirtual && unit.startsWith("s") && unit !== "steps" ? ", in virtual time" : ""}.`;
}

/** Return a line of fishctl without its name. */
export const plain = (line) => line.replace(/^fishctl: /, "");

const received = new WeakMap();

/** Return the time since this state of a job arrived; the clock of the server may be another one [s]. */
function secondsSinceReceived(job) {
  const now = performance.now();
  if (!received.has(job)) received.set(job, now);
  return (now - received.get(job)) / 1000;
}

function Job({ job, state, notice, mayDrive, resume }) {
  const [, tick] = useState(0);
  const runs = job.state === "running";
  useEffect(() => {
    if (!runs) return undefined;
    const timer = setInterval(() => tick((n) => n + 1), 500);
    return () => clearInterval(timer);
  }, [runs]);
  const elapsed = job.elapsed + (runs ? secondsSinceReceived(job) : 0);
  const [, left] = shareOf(job, elapsed), { estimates, doing } = job.progress ?? {}, title = titleOf(state, job.kind);
  const isDone = job.state === "done", hasAnswer = isDone && estimates?.length > 0 && job.kind !== "measure";
  const ask = (what) => () => call("POST", `/api/jobs/${job.id}/${what}`).catch((error) => notice("error", error.message, error.remedy));
  return html`<li class=${`job ${job.state}`}>
    <div class="job-head"><b>${title}</b><span class="pill small">${job.state}</span>
      <span class="muted">${duration(elapsed)}${runs && left ? `, ${left}` : ""}</span>
      <span class="buttons">${runs && html`<button type="button" disabled=${!mayDrive} onClick=${ask("stop")}>Stop</button>`}
        ${job.resumable && html`<button type="button" disabled=${!mayDrive} onClick=${resume}>Resume</button>`}
        ${!runs && html`<button type="button" disabled=${!mayDrive} aria-label=${`Dismiss ${job.kind}`} onClick=${ask("dismiss")}>Dismiss</button>`}</span></div>
    ${runs && html`<${Progress} job=${job} elapsed=${elapsed} />`}
    <${Command} words=${job.command} />
    ${hasAnswer ? html`${doing && html`<p class="result">${sentence(doing)}</p>`}<${Estimates} estimates=${estimates} title="result" />` : html`<${Result} job=${job} status=${state.status} />`}
    <${Growing} points=${job.points} />
    ${(job.state !== "done" || job.exit !== 0) && !(job.state === "stopped" && job.result) && job.lines?.length > 0 && html`<p class="last">${plain(job.lines.at(-1))}</p>`}
  </li>`;
}

function Result({ job, status }) {
  const result = job.result;
  if (!result || typeof result !== "object") return null;
  const [factor, unit] = forceUnit(status);
  const thrust = (value, half) => {
    const [middle, error] = interval(value * factor, half == null ? NaN : half * factor);
    return `${middle} ${error} ${unit}`;
  };
  if (job.kind === "simulate") {
    return html`<p class="result">True thrust <b>${number(result.mean_thrust * 1000, 2)} mN</b> at
      ${" "}<b>${number(result.frequency, 2)} Hz</b>${Number.isFinite(result.relative_thrust)
        && html`, <b>${number(100 * result.relative_thrust, 1)} %</b> of the best square wave`}.
      Dashed in the live chart of the thrust.</p>
      ${result.curve && html`<${Curve} curve=${result.curve} title="Virtual force" />`}`;
  }
  if (Number.isFinite(result.thrust)) {
    return html`<p class="result">Thrust <b>${thrust(result.thrust, halfWidthOf(result))}</b>${Number.isFinite(result.frequency)
      && html` at <b>${number(result.frequency, 2)} Hz</b>`}</p>`;
  }
  if (Array.isArray(result.stretches)) {
    return html`<p class="result">${result.stretches.map((stretch) => html`<b>${stretch.controller}</b>${
      stretch.controller === stretch.recorded ? "" : ` in place of ${stretch.recorded}`}: ${stretch.equal} of
      ${" "}${stretch.ticks} commands are the same${stretch.equal < stretch.ticks && html`, the largest difference is
      ${" "}${number(stretch.largest, 4)} rad`}.
      ${stretch.equal < stretch.ticks && !stretch.from_start && " It swam already when the recording began, so its past is not known."} `)}</p>`;
  }
  if (!Array.isArray(result) || !result.length) return null;
  return html`<table class="result"><thead><tr><th>${job.kind === "sweep" ? "best point" : "controller"}</th>
    <th class="right">thrust</th></tr></thead><tbody>
    ${result.map((row) => html`<tr><td>${row.contestant ?? controllerText(row.controller, row.parameters)}</td>
      <td class="right">${thrust(row.thrust, halfWidthOf(row))}</td></tr>`)}
  </tbody></table>`;
}
