// What is known of the fish's computer and settings: versions, disk, calibrations, configuration, log, and checks.
import { call, html, number, sentence, significant, useEffect, useState } from "./common.js";

const DAY_MS = 86_400_000;
/** Levels of `fishctl doctor` as pills. */
const PILLS = { ok: "running", warning: "stale", FAIL: "fault", skipped: "" };

/** Return the age of a date, in days or hours. */
function ageOf(date) {
  const hours = (Date.now() - new Date(date)) / (DAY_MS / 24);
  if (!Number.isFinite(hours)) return "";
  return hours < 1 ? "less than 1 h ago" : hours < 48 ? `${number(Math.max(0, hours), 0)} h ago` : `${number(hours / 24, 0)} days ago`;
}

const gigabytes = (bytes) => `${number(bytes / 1e9, 1)} GB`;

/** Return a value of the configuration as text. */
const valueText = (value) => (value === undefined || value === null ? "–" : typeof value === "string" ? value : JSON.stringify(value));

/** Read a part of what is known; the function reads it again. */
function usePart(fish, part, isPaired) {
  const [answer, setAnswer] = useState({});
  const load = () => call("GET", `/api/fish/${encodeURIComponent(fish)}/about/${part}`)
    .then((result) => setAnswer({ result }), (failure) => setAnswer({ failure }));
  useEffect(() => {
    if (isPaired) load();
  }, [fish, isPaired]);
  return [answer, load];
}

/** A part: `children` once it is read, else why it is not; `foot` always. */
function Part({ id, title, answer, load, foot, children }) {
  const { result, failure } = answer;
  return html`<section class="panel" aria-labelledby=${`${id}-title`} id=${id}>
    ${load ? html`<div class="head-row"><h2 id=${`${id}-title`}>${title}</h2><button type="button" onClick=${load} aria-label=${`Refresh ${title}`}>Refresh</button></div>`
      : html`<h2 id=${`${id}-title`}>${title}</h2>`}
    ${failure ? html`<p class="note">${sentence(failure.message)} ${sentence(failure.remedy)}</p>` : result ? children : html`<p class="muted">Loading …</p>`}${foot}</section>`;
}

const Table = ({ label, head, rows }) => html`<div class="scroll" tabindex="0" role="region" aria-label=${label}><table class="wrapped">
  <thead><tr>${head.map((text) => html`<th>${text}</th>`)}</tr></thead>
  <tbody>${rows.map((cells) => html`<tr>${cells.map((cell) => html`<td>${cell}</td>`)}</tr>`)}</tbody></table></div>`;

export function About({ fish, isPaired, act, mayRestart }) {
  const [computer] = usePart(fish, "computer", isPaired), [disk] = usePart(fish, "disk", isPaired);
  const [settings] = usePart(fish, "settings", isPaired), [camera] = usePart(fish, "camera", isPaired);
  const [log, loadLog] = usePart(fish, "log", isPaired);
  return html`<div class="about"><div>
    <${Part} id="computer" title="Computer" answer=${computer}><${Computer} computer=${computer.result} ...${{ disk, act, mayRestart }} /><//>
    <${Part} id="calibrations" title="Calibrations" answer=${settings}><${Calibrations} rows=${[...settings.result?.calibrations ?? [], ...camera.result ?? []]} /><//>
    <${Part} id="configuration" title="Configuration" answer=${settings}><${Configuration} keys=${settings.result?.keys} /><//></div>
    <div><${Checks} fish=${fish} isService=${computer.result?.is_service} />
    <${Part} id="log" title="Log" answer=${log} load=${loadLog}>
      ${log.result?.problem && html`<p class="muted">${sentence(log.result.problem)}</p>`}
      ${log.result?.lines.length > 0 && html`<pre tabindex="0" aria-label="Latest lines last">${log.result.lines.join("\n")}</pre>`}<//></div></div>`;
}

function Computer({ computer, disk: { result: disk, failure }, act, mayRestart }) {
  const hours = disk && disk.free / disk.hourly;
  const source = disk?.recordings ? `as in ${disk.recordings === 1 ? "the latest recording" : `the latest ${disk.recordings} recordings`}` : "as is usual without a camera";
  const room = failure ? sentence(failure.message) : !disk ? "Loading …" : disk.free === null ? "unknown" : html`${gigabytes(disk.free)} of ${gigabytes(disk.size)} free:
    about ${hours < 48 ? `${significant(hours, 2)} hours` : `${significant(hours / 24, 2)} days`} of recording at ${number(disk.hourly / 1e6, 1)} MB an hour, ${source}`;
  return html`<dl>${computer.rows.map(({ name, value }) => html`<dt>${name}</dt><dd>${value}</dd>`)}
    <dt>disk</dt><dd>${room}</dd>
    ${computer.is_service && html`<dt>restart</dt><dd><button type="button" disabled=${!mayRestart} onClick=${() => act("restart", {})}>Restart fishd</button>
      <span class="muted">It reads its configuration again, while no controller runs.</span></dd>`}</dl>`;
}

const Calibrations = ({ rows }) => (rows.length === 0 ? html`<p class="muted">This robot has none.</p>`
  : html`<${Table} label="Calibrations" head=${["what", "age", "about"]} rows=${rows.map(({ what, date, note }) => [
    what, date ? html`<span title=${date}>${ageOf(date)}</span>` : "never", sentence(note)])} />`);

function Configuration({ keys }) {
  const [all, setAll] = useState(false);
  const own = keys.filter(({ differs }) => differs), shown = all ? keys : own;
  return html`<label class="special"><input type="checkbox" checked=${all} onChange=${(event) => setAll(event.target.checked)} />
      show all ${keys.length} keys, not only those (${own.length}) that differ from the defaults</label>
    ${shown.length > 0 && html`<${Table} label="Configuration" head=${["key", "value", "default"]} rows=${shown.map(({ key, value, default: standard, differs }) => [
      html`<${differs ? "b" : "span"}>${key.split(".").map((part, index) => [index > 0 && html`.<wbr />`, part])}<//>`, valueText(value), differs ? valueText(standard) : ""])} />`}`;
}

/** The checks of `fishctl doctor`, run when asked for. */
function Checks({ fish, isService }) {
  const [answer, setAnswer] = useState({ result: [] });
  const [isRunning, setRunning] = useState(false);
  const run = async () => {
    setRunning(true);
    await call("POST", `/api/fish/${encodeURIComponent(fish)}/doctor`).then((result) => setAnswer({ result }), (failure) => setAnswer({ failure }));
    setRunning(false);
  };
  return html`<${Part} id="checks" title="Checks" answer=${answer} foot=${html`<div class="buttons">
      <button type="button" disabled=${isRunning} onClick=${run}>${isRunning ? "They run …" : "Run the checks"}</button>
      <span class="muted">As fishctl doctor does; nothing moves.${isService && " The page sees no devices: for these, type sudo -u fishd fishctl doctor."}</span></div>`}>
    ${answer.result?.length > 0 && html`<${Table} label="Checks" head=${["result", "check", "about"]} rows=${answer.result.map(({ check, level, message, remedy }) => [
      html`<span class=${`pill small ${PILLS[level] ?? ""}`}>${level === "FAIL" ? "failed" : level}</span>`, check,
      html`${message}${remedy && html`<br /><span class="muted">${remedy}</span>`}`])} />`}<//>`;
}
