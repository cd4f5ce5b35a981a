// The kept runs: a table that is filtered and sorted, the comparison of some, and the trash.
import { call, duration, forceUnit, html, interval, sentence, useEffect, useState } from "./common.js";
import { halfWidthOf } from "./experiments.js";
import { Comparison } from "./results.js";
import { idOf, isInProgress, Run } from "./run.js";
import { Trash } from "./trash.js";

/** Number of runs that are shown at first, and by which more are shown. */
const PAGE_RUNS = 40;
const MAX_COMPARED = 12;
/** Number of days back from now to the begin of a run, by title. */
const AGES = { "any time": Infinity, "last day": 1, "last week": 7, "last month": 31, "last year": 366 };
const shortDate = new Intl.DateTimeFormat([], { month: "short", day: "numeric", hour: "2-digit", minute: "2-digit", hourCycle: "h23" });

const beginOf = (run) => run.began ?? run.about?.started ?? "";
const numberOf = (run) => Number(run.number ?? run.about?.number ?? 0);
const UNNAMED = "unnamed";
/** Return the name of the fish, if it has one, and whether it was a simulated one. */
const fishOf = ({ on, about }) => [about?.subject, [on, about?.source].includes("simulation") && "simulated"].filter(Boolean).join(", ") || UNNAMED;
const timeOf = (run) => Date.parse(beginOf(run)) || 0;
const compareTexts = (get) => (a, b) => get(a).localeCompare(get(b), undefined, { numeric: true });

/** Return the names of the controllers of a run. */
const controllersOf = (run, known) => (run.kind === "recording" ? Object.keys(run.swim_ticks ?? {})
  : [...new Set((run.command ?? []).map((word) => word.split(":")[0]))].filter((word) => known.includes(word)));

/** Return what a run is, in a few words. */
const whatOf = (run) => (run.kind === "recording" ? Object.keys(run.swim_ticks ?? {}).join(", ") || "at rest" : run.kind);

const ORDERS = {
  "newest first": (a, b) => timeOf(b) - timeOf(a) || numberOf(b) - numberOf(a),
  "oldest first": (a, b) => timeOf(a) - timeOf(b) || numberOf(a) - numberOf(b),
  name: compareTexts((run) => run.name),
  what: compareTexts(whatOf),
  fish: compareTexts(fishOf),
  "longest first": (a, b) => (b.duration ?? -1) - (a.duration ?? -1),
  "most thrust first": (a, b) => (b.thrust ?? -Infinity) - (a.thrust ?? -Infinity),
};

/** Return whether a run has all words of a text in its name, its kind, or what is noted of it, or as its date. */
function hasWords(run, text) {
  const { note, operator } = run.about ?? {};
  const known = [run.name, whatOf(run), fishOf(run), note, operator, ...(run.command ?? [])].join(" ").toLowerCase();
  return text.toLowerCase().split(/\s+/).every((word) => known.includes(word)
    || (word.length >= 4 && beginOf(run).startsWith(word)));
}

export function Runs(page) {
  const { state } = page;
  const [runs, setRuns] = useState(null), [failure, setFailure] = useState(null);
  const [open, setOpen] = useState(null), [count, setCount] = useState(PAGE_RUNS);
  const [filter, setFilter] = useState({ text: "", controller: "", age: "any time", order: "newest first" });
  const [picked, setPicked] = useState([]), [compared, setCompared] = useState(null), [changes, setChanges] = useState(0);
  const isShown = state.place === "runs" && Boolean(state.session?.paired);
  const finished = [...state.jobs.values()].filter(({ state: at }) => at !== "running").length;
  const load = () => call("GET", "/api/runs").then((found) => {
    setRuns(found);
    setPicked((before) => before.filter((id) => found.some((run) => idOf(run) === id)));
    setFailure(null);
  }).catch(setFailure);
  useEffect(() => {
    if (isShown) load();
  }, [finished, changes, isShown, state.linked]);
  const known = state.controllers.map(({ name }) => name);
  const controllers = [...new Set((runs ?? []).flatMap((run) => controllersOf(run, known)))].sort();
  const set = (name) => (event) => {
    setFilter({ ...filter, [name]: event.target.value });
    setCount(PAGE_RUNS);
  };
  const choose = (title, name, values) => html`<label>${title} <select value=${filter[name]} onChange=${set(name)}>
    ${Object.keys(values).map((value) => html`<option value=${value}>${value}</option>`)}</select></label>`;
  const shown = (runs ?? []).filter((run) => hasWords(run, filter.text.trim())
    && (!filter.controller || controllersOf(run, known).includes(filter.controller))
    && timeOf(run) >= Date.now() - 86_400_000 * AGES[filter.age]).sort(ORDERS[filter.order]);
  const pick = (id) => () => setPicked((before) => (before.includes(id) ? before.filter((other) => other !== id) : [...before, id]));
  const changed = () => setChanges((n) => n + 1);
  const hasFish = (runs ?? []).some((run) => fishOf(run) !== UNNAMED);
  return html`
    <div class="head-row"><h2 id="runs-title">Runs</h2><span class="muted" role="status">${runs
      && (shown.length === runs.length ? `${runs.length}` : `${shown.length} of ${runs.length}`)}</span>
      <button type="button" onClick=${changed}>Refresh</button></div>
    ${runs?.length > 0 && html`<div class="filter">
      <label>Find <input type="search" placeholder="name, fish, note, date" value=${filter.text} onInput=${set("text")} /></label>
      <label>Controller <select value=${filter.controller} onChange=${set("controller")}><option value="">any</option>
        ${controllers.map((name) => html`<option value=${name}>${name}</option>`)}</select></label>
      ${choose("Began", "age", AGES)}${choose("Sort by", "order", ORDERS)}</div>`}
    ${picked.length > 0 && html`<div class="buttons picked"><button type="button" class="primary" disabled=${picked.length < 2 || picked.length > MAX_COMPARED}
      onClick=${() => setCompared(picked)}>Compare ${picked.length}</button>
      <button type="button" onClick=${() => setPicked([])}>Pick none</button>
      <span class="muted">${picked.length < 2 ? "Pick another one." : picked.length > MAX_COMPARED && `At most ${MAX_COMPARED}.`}</span></div>`}
    ${compared && html`<${Comparison} key=${compared.join()} runs=${compared} close=${() => setCompared(null)} />`}
    ${failure && html`<p class="note">The runs cannot be listed. ${sentence(failure.message)} ${sentence(failure.remedy)}</p>`}
    ${runs === null ? !failure && html`<p class="muted">Loading …</p>` : runs.length === 0
      ? html`<p class="muted complete">None yet. Record, measure or sweep, and it is listed here.</p>`
      : html`<div class="scroll complete" tabindex="0" role="region" aria-label="Table of runs"><table class=${`runs ${hasFish ? "" : "no-fish"}`}>
        <thead><tr><th><span class="unseen">compare</span></th><th>name</th><th>what</th><th class="fish">fish</th><th>began</th>
          <th class="right">length</th><th class="right">thrust</th><th class="right lost">lost ticks</th><th><span class="unseen">what to do</span></th></tr></thead>
        <tbody>${shown.slice(0, count).map((run) => {
          const id = idOf(run), isOpen = open === id;
          return html`<${Line} key=${id} run=${run} isOpen=${isOpen} isPicked=${picked.includes(id)} pick=${pick(id)}
              toggle=${() => setOpen(isOpen ? null : id)} />
            ${isOpen && html`<tr key=${`${id}/`} class="plot-row"><td colspan="9"><div class="opened"><${Run} run=${run} page=${page} changed=${changed}
              open=${setOpen} /></div></td></tr>`}`;
        })}</tbody></table></div>`}
    ${shown.length > count && html`<button type="button" onClick=${() => setCount(count + PAGE_RUNS)}>Show ${Math.min(PAGE_RUNS, shown.length - count)} more</button>`}
    <${Trash} page=${page} changes=${changes} changed=${changed} />`;
}

function Line({ run, isOpen, isPicked, pick, toggle }) {
  const [factor, unit] = forceUnit(run), half = halfWidthOf(run), begin = beginOf(run);
  const [middle, error] = run.thrust == null ? ["", ""] : interval(run.thrust * factor, half == null ? NaN : half * factor);
  return html`<tr class=${run.problem ? "damaged" : ""}>
    <td class="pick"><input type="checkbox" checked=${isPicked} aria-label=${`Compare ${run.name}`} onChange=${pick} /></td>
    <td class="name">${run.name}${(isInProgress(run) || run.state === "unfinished") && html` <span class="pill small">${run.state}</span>`}
      ${run.about?.note && html`<br /><small>${run.about.note}</small>`}${run.problem && html`<br /><small>${run.problem}</small>`}</td>
    <td class="what">${whatOf(run)}</td><td class="fish">${fishOf(run)}</td><td class="began">${begin && shortDate.format(new Date(begin))}</td>
    <td class="length right">${run.duration == null ? "" : duration(run.duration)}${run.kind === "sweep" && run.rows ? ` ${run.rows} points` : ""}</td>
    <td class="thrust right">${middle} ${error} ${run.thrust == null ? "" : unit}</td>
    <td class="lost right">${run.lost_ticks ?? ""}</td>
    <td class="actions"><button type="button" aria-expanded=${isOpen} aria-label=${`${isOpen ? "Close" : "Open"} ${run.name}`}
      onClick=${toggle}>${isOpen ? "Close" : "Open"}</button></td></tr>`;
}
