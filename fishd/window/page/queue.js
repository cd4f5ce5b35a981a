// The queue of experiments of this fish: what runs, what waits, how long it takes. `fishctl queue` shows the same.
import { call, Command, duration, html, numberIn, sentence, useEffect, useState } from "./common.js";
import { startJob } from "./experiments.js";
import { Text } from "./fields.js";
import { Growing, Progress } from "./progress.js";
import { CHECK_TIMEOUT_MS } from "./forms.js";

/** Pause between two questions about the queue, by the part of the page that is shown. */
const POLL_MS = { experiments: 2000, live: 5000 };
const clock = new Intl.DateTimeFormat([], { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const timeText = (t) => clock.format(new Date(t * 1000));

/** Number of the latest request; an answer to an earlier one is old. */
let latest = 0;

/** Send a request about the queue, and keep the answer in the state; return the error if it fails. */
async function ask({ state, changed }, change) {
  const mine = ++latest, path = `/api/fish/${encodeURIComponent(state.name)}/queue`;
  try {
    const queue = await (change ? call("POST", path, change, CHECK_TIMEOUT_MS) : call("GET", path));
    if (mine === latest) state.queue = { ...queue, received: performance.now(), failure: "" };
  } catch (error) {
    if (!change && mine === latest) state.queue = { ...state.queue, failure: error.message };
    return error;
  } finally {
    changed();
  }
  return null;
}

/** Change the queue; say why that was refused. */
async function change(page, op, args = {}) {
  const error = await ask(page, { op, ...args });
  if (error) page.notice("error", error.message, error.remedy);
}

/** The button that adds an experiment to the queue, beside the one that starts it. */
export function AddToQueue({ page, kind, options, disabled }) {
  const [isAdding, setAdding] = useState(false);
  const add = async () => {
    setAdding(true);
    await change(page, "add", { kind, options });
    setAdding(false);
  };
  return html`<button type="button" disabled=${disabled || isAdding} onClick=${add}>${isAdding ? "Adding …" : "Add to queue"}</button>`;
}

/** Return the unix time at which a clock next shows a time of day, such as 18:00 or 1800; NaN if it is none. */
function nextTime(text) {
  const [, hours, minutes] = /^ *(\d{1,2})[:. ]?(\d\d) *$/.exec(text) ?? [], when = new Date();
  if (!(hours < 24 && minutes < 60)) return NaN;
  when.setHours(hours, minutes, 0, 0);
  if (when <= Date.now()) when.setDate(when.getDate() + 1);
  return when / 1000;
}

/** What the queue does, and what comes next, in a line for the part Live; nothing while it is empty. */
export function QueueLine({ page }) {
  const { queue, session, place } = page.state, { items = [], current, pauses } = queue ?? {};
  if (place !== "live" || items.length === 0) return null;
  const item = items.find(({ id }) => id === current), next = item?.repeat > 1 ? item : items.find(({ id }) => id !== current);
  const name = ({ words }) => html`<b>${words.filter((word) => word !== "--on=live").join(" ")}</b>`;
  return html`<div class="role with" id="queue-line"><span>Queue: ${!item ? `${queue.state}, ${items.length} in it.`
      : html`${name(item)}, ${pauses ? "then it pauses." : next ? html`then ${name(next)}.` : "the last one."}`}</span>
    ${item ? html`<button type="button" disabled=${session?.scope !== "drive"}
      onClick=${() => change(page, pauses ? "cancel-pause" : "pause")}>${pauses ? "Do not pause" : "Pause after it"}</button>`
      : html`<a class="link" href="#experiments">Show</a>`}</div>`;
}

export function Queue({ page }) {
  const { state } = page, { queue } = state;
  const isShown = state.place in POLL_MS && Boolean(state.session?.paired) && Boolean(state.name);
  useEffect(() => {
    if (!isShown) return undefined;
    let timer, isOver = false;
    const poll = async () => {
      if (!document.hidden) await ask(page);
      if (!isOver) timer = setTimeout(poll, POLL_MS[state.place]);
    };
    poll();
    return () => {
      isOver = true;
      clearTimeout(timer);
    };
  }, [isShown, state.place, state.name]);
  if (!queue?.items) return html`<h3 class="queue-title">Queue</h3><p class="muted">${queue ? sentence(queue.failure) : "Loading …"}</p>`;
  const mayDrive = state.session?.scope === "drive", isRunning = queue.state === "running";
  const passed = isRunning && queue.current !== null ? (performance.now() - queue.received) / 1000 : 0;
  const job = [...state.jobs.values()].find(({ kind, fish, state: at }) => kind === "queue" && fish === state.name && at === "running");
  const left = Math.max(0, queue.left - passed), about = queue.unknown ? "at least" : "about";
  const button = (text, action, kind = "") => html`<button type="button" class=${kind} disabled=${!mayDrive} onClick=${action}>${text}</button>`;
  const send = (op, args) => () => change(page, op, args);
  const stopAt = (text) => {
    const at = nextTime(text);
    if (at) change(page, "pause", { at });
    else page.notice("warning", `'${text}' is not a time of day`, "Write it as 18:00.");
  };
  return html`<section class="queue" aria-labelledby="queue-title">
    <div class="head-row"><h3 class="queue-title" id="queue-title">Queue <span class=${`pill small ${queue.state}`}>${queue.state}</span></h3>
      ${queue.items.length > 0 && html`<span class="muted">${queue.items.length} in it, ${about} ${duration(left, true)}, until ${timeText(Date.now() / 1000 + left)} ${
        isRunning ? "" : "if it starts now"}</span>`}</div>
    ${queue.failure && html`<p class="note">${sentence(queue.failure)}</p>`}
    ${queue.state === "paused" && queue.reason && html`<p class="note">${sentence(`It pauses: ${queue.reason}`)} What was interrupted is resumed at the next start.</p>`}
    ${queue.items.length === 0 && html`<p class="muted">Empty. Add experiments above; they wait here, also when this page is closed, and run one after another.</p>`}
    <ol aria-label="Experiments in the queue">
      ${queue.items.map((item, place) => html`<${Item} key=${item.id} ...${{ item, place, queue, mayDrive, passed, send, job }} />`)}
    </ol>
    ${(queue.items.length > 0 || isRunning) && html`<div class="buttons">
      ${!isRunning ? button("Start queue", () => startJob(page, "queue", {}), "primary")
        : html`${!queue.pauses && button("Pause after this one", send("pause"))}${button("Stop now", send("stop"), "stop")}`}
      <label class="special">Stop at <${Text} class="number" placeholder="18:00" disabled=${!mayDrive}
        value=${queue.pause_at === null ? "" : timeText(queue.pause_at)} commit=${stopAt} /></label>
      ${(queue.pauses || queue.pause_at !== null) && button("Do not pause", send("cancel-pause"))}
      ${button("Clear", send("clear"))}
      ${queue.pauses && html`<span class="muted">It pauses after this run.</span>`}</div>`}
    ${queue.past.length > 0 && html`<details><summary>Latest runs</summary><ul aria-label="Latest runs of the queue">
      ${queue.past.slice().reverse().map((past) => html`<li key=${past.run + past.ended}><span class=${`pill small ${past.outcome}`}>${past.outcome}</span>
        ${" "}${timeText(past.ended)} <b>${past.run}</b> ${past.message}</li>`)}</ul></details>`}
  </section>`;
}

/** job: the runner that this page knows, with the progress of the experiment that runs */
function Item({ item, place, queue, mayDrive, passed, send, job }) {
  const runs = item.id === queue.current, number = { number: item.id }, words = item.words.join(" ");
  const elapsed = queue.elapsed + passed, each = item.seconds === null ? "" : duration(item.seconds, true);
  const waits = item.run ? "interrupted, is resumed" : "waits";
  const what = runs ? `runs, ${duration(elapsed)}${each && ` of about ${each}`}` : `${waits}${each && `, about ${each} each`}`;
  const button = (text, label, action, isOff) => html`<button type="button" aria-label=${`${label} ${words}`} title=${label}
    disabled=${!mayDrive || isOff} onClick=${action}>${text}</button>`;
  return html`<li class="queued">
    <div class="job-head"><span class="muted">${what}</span><span class="buttons">
      <label class="special">Runs <${Text} class="number" inputmode="numeric" value=${item.repeat} disabled=${!mayDrive} aria-label=${`Runs of ${words}`}
        commit=${(text) => send("repeat", { ...number, repeat: numberIn(text) })()} /></label>
      ${button("↑", "Move up", send("move", { ...number, position: place }), place === 0)}
      ${button("↓", "Move down", send("move", { ...number, position: place + 2 }), place === queue.items.length - 1)}
      ${button("Remove", "Remove", send("remove", number), runs)}</span></div>
    ${runs && job?.progress ? html`<${Progress} job=${job} />` : runs && item.seconds !== null && html`<progress max=${item.seconds} value=${Math.min(elapsed, item.seconds)} aria-label=${`Progress of ${words}`}></progress>`}
    <${Command} words=${["fishctl", ...item.words]} />
    ${runs && html`<${Growing} points=${job?.points} />`}</li>`;
}
