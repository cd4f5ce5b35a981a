// Experiments as child processes of the server: a form, and the jobs with the command line that each ran.
import { call, controllerText, duration, forceUnit, html, interval, number, numberIn, quote, recall, remember, sentence, useEffect, useState } from "./common.js";
import { Curve } from "./curve.js";
import { defaultOf, missingOf, selectionOf, shownParameters } from "./fields.js";
import { AddToQueue, Queue } from "./queue.js";

const KINDS = {
  measure: { title: "Measure", text: "Swims and rests in turn; thrust with its 95 % interval." },
  sweep: { title: "Sweep", text: "Measures over values of one parameter." },
  compare: { title: "Compare", text: "Measures several controllers on this fish." },
  record: { title: "Record", text: "Writes every tick, event and status to a file." },
  simulate: { title: "Try first", text: "Swims a simulated fish in virtual time; the real one rests." },
};

/** Pause after an entry until the server is asked about it. */
const CHECK_MS = 200;

/** Return an input with its label; `set` gets its text. */
const input = (label, value, set, more = {}) => html`<label class="row"><span>${label}</span>
  <input value=${value} autocomplete="off" onInput=${(event) => set(event.target.value)} ...${more} /></label>`;

/** Kinds that swim the fish, and so need the driver's role. */
const DRIVING = ["measure", "sweep", "compare", "resume", "queue"];

/** Start a job; take the driver's role first where it needs it. Say why it was refused, and offer to take the fish. */
export async function startJob({ state, notice, changed, becomeDriver }, kind, options, take = false) {
  const drives = DRIVING.includes(kind);
  try {
    if (drives && (take || !state.driver?.you_drive)) await becomeDriver(take);
    const more = drives && take ? { take } : {};
    const job = await call("POST", "/api/jobs", { fish: state.name, kind, options: { ...options, ...more } });
    state.jobs.set(job.id, job);
    changed();
  } catch (error) {
    const remedies = { driven: "Take over", "not-driver": "Take over", leased: "Take the fish" };
    notice("error", error.message, error.remedy, remedies[error.code] && [remedies[error.code], () => startJob({ state, notice, changed, becomeDriver }, kind, options, true)]);
  }
}

/** Return the half-width of a thrust's interval, with the calibration where that is known. */
export const halfWidthOf = ({ thrust_ci95: statistical, total_ci95: total }) => total ?? statistical;

/** Return the thrust of the newest simulated fish among the jobs [N]; null without one, or where the true force is in another unit. */
export function triedThrust({ jobs, status }) {
  const tried = [...jobs.values()].filter(({ kind, state }) => kind === "simulate" && state === "done").at(-1)?.result.mean_thrust;
  return Number.isFinite(tried) && forceUnit(status)[1] === "mN" ? tried : null;
}

/** Return the command line of a job and what is wrong with it, both as the server says. */
function useCheck(fish, kind, options, isReady) {
  const [answer, setAnswer] = useState({ command: [], problem: "" });
  const body = JSON.stringify({ fish, kind, options });
  useEffect(() => {
    if (!isReady) return undefined;
    let isOld = false;
    const timer = setTimeout(() => call("POST", "/api/jobs/check", JSON.parse(body)).then(
      (checked) => isOld || setAnswer(checked),
      (error) => isOld || setAnswer({ command: [], problem: error.message }),
    ), CHECK_MS);
    return () => {
      isOld = true;
      clearTimeout(timer);
    };
  }, [body, isReady]);
  return answer;
}

/** Leave out what is not given: the server has its own defaults. */
const given = (options) => Object.fromEntries(Object.entries(options).filter(([, value]) => value !== null));

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

export function Experiments(page) {
  const { state, notice } = page;
  const [form, setForm] = useState(() => recall("experiment", {
    kind: "measure", seconds: "", values: "", parameter: "", contestants: "square swing", runs: "", subject: "", note: "",
  }));
  const { controller, own, missing } = selectionWithOwn(state);
  const set = (key) => (value) => {
    const next = { ...form, [key]: value };
    remember("experiment", next);
    setForm(next);
  };
  const mayDrive = state.session?.scope === "drive";
  const names = (controller?.parameters ?? []).filter(({ kind }) => kind === "number" || kind === "integer").map(({ name }) => name);
  const varied = names.includes(form.parameter) ? form.parameter : names[0];
  const seconds = form.seconds.trim() === "" ? null : numberIn(form.seconds);

  const uses = ["measure", "sweep", "simulate"].includes(form.kind);

  const options = () => {
    switch (form.kind) {
      case "record": return { seconds, subject: form.subject || null, note: form.note || null };
      case "compare": return { contestants: form.contestants.split(/\s+/).filter(Boolean), seconds, runs: form.runs.trim() === "" ? null : numberIn(form.runs) };
      case "sweep": return { controller: controller.name, parameters: { ...own, [varied]: form.values }, seconds };
      default: return { controller: controller.name, parameters: own, seconds };
    }
  };
  const isEmpty = form.kind === "sweep" ? !form.values.trim() : form.kind === "compare" && !form.contestants.trim();
  const hasNothing = form.kind === "sweep" && controller && names.length === 0;
  const needs = uses && missing.length > 0;
  const isReady = Boolean(controller) && !isEmpty && !hasNothing && !needs && Boolean(state.session?.paired);
  const { command, problem } = useCheck(state.name, form.kind, isReady ? given(options()) : {}, isReady);
  const total = isReady && command.length ? expected(command) : null;
  const start = (event) => {
    event.preventDefault();
    startJob(page, form.kind, given(options()));
  };
  const jobs = [...state.jobs.values()].filter(({ fish, kind }) => kind !== "queue" && (!fish || fish === state.name)).sort((a, b) => b.id - a.id).slice(0, 8);
  return html`
    <h2 id="experiments-title">Experiments</h2>
    <div class="tabs" role="tablist" aria-label="Kind of experiment">
      ${Object.entries(KINDS).map(([kind, { title }]) => html`<button type="button" role="tab" id=${`tab-${kind}`}
        aria-selected=${form.kind === kind} aria-controls="experiment" onClick=${() => set("kind")(kind)}>${title}</button>`)}
    </div>
    <form id="experiment" role="tabpanel" aria-labelledby=${`tab-${form.kind}`} onSubmit=${start}>
      <p class="summary">${KINDS[form.kind].text}</p>
      ${uses && controller && html`<p class="with">With <b>${controllerText(controller.name, own)}</b><span class="muted">, as in the panel Controller</span></p>`}
      <div class="form">
        ${form.kind === "sweep" && html`<label class="row"><span>Parameter</span>
          <select value=${varied} onChange=${(event) => set("parameter")(event.target.value)}>
            ${names.map((name) => html`<option value=${name}>${name}</option>`)}</select></label>
          ${input("Values", form.values, set("values"), { required: true, placeholder: "1:2:0.2 or 1,1.5,2" })}`}
        ${form.kind === "compare" && html`
          ${input("Contestants", form.contestants, set("contestants"), { required: true, placeholder: "square swing:C=0.6" })}
          ${input("Runs of each", form.runs, set("runs"), { inputmode: "numeric", placeholder: "1", class: "number" })}`}
        ${form.kind === "record" && html`
          ${input("Fish", form.subject, set("subject"), { placeholder: "name or number" })}
          ${input("Note", form.note, set("note"), { placeholder: "purpose" })}`}
        ${input("Seconds", form.seconds, set("seconds"), {
          inputmode: "decimal", class: "number", placeholder: { record: "until stopped", sweep: "30 each", simulate: "20" }[form.kind] ?? "60",
          "aria-invalid": isReady && problem !== "", "aria-describedby": "preview",
        })}
      </div>
      <div id="preview" aria-live="polite">
        ${hasNothing ? html`<p class="muted">${controller.name} has no number to sweep: choose another controller.</p>`
          : needs ? html`<p class="muted">Needed first, in the panel Controller: ${missing.map(({ name }) => name).join(", ")}.</p>`
          : isReady && problem ? html`<p class="note">${sentence(problem)}</p>`
            : isReady && command.length > 0 && html`<code tabindex="0" aria-label="Command line to come">${command.map(quote).join(" ")}</code>
              ${total && html`<p class="muted">Takes about ${duration(total)}${form.kind === "simulate" ? " of virtual time" : ""}.</p>`}`}
      </div>
      <div class="buttons">
        <button class="primary" disabled=${!mayDrive || !isReady || problem !== ""}>${form.kind === "simulate" ? "Try on a simulated fish" : KINDS[form.kind].title}</button>
        ${DRIVING.includes(form.kind) && html`<${AddToQueue} page=${page} kind=${form.kind} options=${() => given(options())} disabled=${!mayDrive || !isReady || problem !== ""} />`}
        ${form.kind === "compare" && controller && html`<button type="button"
          onClick=${() => set("contestants")(`${form.contestants.trim()} ${controllerText(controller.name, own)}`.trim())}>Add ${controller.name}</button>`}
      </div>
    </form>
    <${Queue} page=${page} />
    <ul class="jobs" aria-label="Started experiments">
      ${jobs.map((job) => html`<${Job} key=${job.id} job=${job} state=${state} notice=${notice} mayDrive=${mayDrive}
        resume=${() => startJob(page, "resume", { run: job.run })} />`)}
    </ul>`;
}

/** Return the number of values that a sweep measures for a word such as 1,1.5,2 or 0.4:4:0.2. */
const countValues = (word) => word.split(",").reduce((sum, part) => {
  const [low, high, step] = part.split(":").map(Number);
  return sum + (step > 0 ? Math.floor((high - low) / step + 1e-6) + 1 : 1);
}, 0);

/** Return the expected duration of a job from its command line; null if it is not known. */
function expected([, verb, ...words]) {
  const valueOf = (name) => (words.includes(name) ? words[words.indexOf(name) + 1] : null);
  const each = Number(valueOf("--for") ?? NaN);
  const place = words.findIndex((word) => word.startsWith("--"));
  const times = {
    measure: () => 1, record: () => 1, simulate: () => 1,
    sweep: () => words.reduce((product, word) => product * (/^[\d.]+[,:]/.test(word) ? countValues(word) : 1), 1),
    compare: () => place * Number(valueOf("--runs") ?? 1),
  }[verb];
  const seconds = times ? times() * each : NaN;
  return seconds > 0 ? seconds : null;
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
  const total = job.kind === "simulate" ? null : expected(job.command), ends = runs && total && elapsed > total;
  const ask = (what) => () => call("POST", `/api/jobs/${job.id}/${what}`).catch((error) => notice("error", error.message, error.remedy));
  return html`<li class=${`job ${job.state}`}>
    <div class="job-head"><b>${KINDS[job.kind]?.title ?? "Rerun"}</b><span class="pill small">${job.state}</span>
      <span class="muted">${job.state === "lost" ? "" : duration(elapsed)}${ends ? ", soon at its end" : runs && total ? ` of about ${duration(total)}` : ""}</span>
      <span class="buttons">${runs && html`<button type="button" disabled=${!mayDrive} onClick=${ask("stop")}>Stop</button>`}
        ${job.resumable && html`<button type="button" disabled=${!mayDrive} onClick=${resume}>Resume</button>`}
        ${!runs && html`<button type="button" disabled=${!mayDrive} aria-label=${`Dismiss ${job.kind}`} onClick=${ask("dismiss")}>Dismiss</button>`}</span></div>
    ${runs && html`<progress key=${`${total && !ends}`} max=${total ?? undefined} value=${total && !ends ? elapsed : undefined}
      aria-label=${`Progress of ${job.kind}`}></progress>`}
    <code tabindex="0" aria-label="Command line">${job.command.map(quote).join(" ")}</code>
    <${Result} job=${job} status=${state.status} />
    ${job.state !== "done" && !(job.state === "stopped" && job.result) && job.lines?.length > 0 && html`<p class="last">${plain(job.lines.at(-1))}</p>`}
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
