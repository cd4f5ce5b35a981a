// Results of runs with their intervals, side by side, and pictures that the server draws.
import { call, fetchPicture, html, interval, sentence, significant, useEffect, useMemo, useRef, useState } from "./common.js";
import { textsOf } from "./progress.js";
import { QUANTITIES, quantityOf, Rows } from "./rows.js";

const queryOf = (runs) => new URLSearchParams(runs.map((run) => ["run", run]));

/** Return the results of runs, null until they are there, and why they cannot be read. */
export function useResults(runs) {
  const [answer, setAnswer] = useState([null, ""]);
  useEffect(() => {
    let isOld = false;
    call("GET", `/api/results?${queryOf(runs)}`).then((results) => isOld || setAnswer([results, ""]),
      (error) => isOld || setAnswer([null, error.message]));
    return () => { isOld = true; };
  }, [runs.join("/")]);
  return answer;
}

/** Return the tables of several runs as one, with their common columns and the runs as groups; null without a table. */
function joinTables(results) {
  const tables = results.filter(({ labels, force_unit: unit }, _, [first]) => labels.length > 1 && unit === first.force_unit);
  const names = Object.keys(tables[0]?.columns ?? {}).filter((name) => tables.every(({ columns }) => name in columns));
  if (names.length < 2) return null;
  const columns = Object.fromEntries(names.map((name) => [name, tables.flatMap((table) => table.columns[name])]));
  const labels = tables.flatMap(({ name, labels: own }) => own.map((label) => (new Set(own).size > 1 ? `${name}: ${label}` : name)));
  return { columns, labels, name: "the runs", force_unit: tables[0].force_unit };
}

/** Runs side by side: a table of their results, their rows in one chart, and the traces of recordings over each other. */
export function Comparison({ runs, close }) {
  const [results, failure] = useResults(runs);
  const joined = useMemo(() => results && joinTables(results), [results]);
  const node = useRef(null);
  useEffect(() => node.current.scrollIntoView(), []); // the runs may be picked far below
  return html`<section class="comparison" aria-label="Comparison" ref=${node}>
    <div class="head-row"><h3>Comparison</h3><button type="button" onClick=${close}>Close comparison</button></div>
    ${failure ? html`<p class="note">${sentence(failure)}</p>` : results ? html`<${Results} results=${results} />` : html`<p class="muted">Loading …</p>`}
    ${joined && html`<${Rows} result=${joined} />`}
    ${results?.some(({ labels }) => labels.length < 2) && html`<${Picture} path=${`/api/results.png?${queryOf(runs)}`} title="the runs over each other" />`}</section>`;
}

export function Results({ results }) {
  const rows = results.flatMap((result) => result.rows.map((row) => ({ ...row, result })));
  const names = Object.keys(QUANTITIES).filter((name) => rows.some(({ values }) => values[name]));
  const several = results.length > 1;
  const text = (name, { values, result }) => {
    if (!values[name]) return "–";
    const [, factor, unit] = quantityOf(name, result.force_unit), [value, half] = values[name];
    return unit === "%" && half == null ? `${significant(value * factor, 4)} %` : `${interval(value * factor, half == null ? NaN : half * factor).join(" ")} ${unit}`;
  };
  return html`
    ${names.length > 0 && html`<div class="scroll" tabindex="0" role="region" aria-label="Results"><table class="results">
      <thead><tr>${several && html`<th>run</th>`}<th>controller</th>${names.map((name) => html`<th class="right">${QUANTITIES[name][0]}</th>`)}</tr></thead>
      <tbody>${rows.map((row) => html`<tr>${several && html`<td>${row.result.name}</td>`}<td>${row.label}</td>
        ${names.map((name) => html`<td class="right">${text(name, row)}</td>`)}</tr>`)}</tbody></table></div>`}
    ${results.map(({ name, summary, estimates }) => html`
      ${summary && html`<p>${several && html`<b>${name}</b>: `}${sentence(summary)}</p>`}
      ${estimates.length > 0 && html`<ul class="estimates">${estimates.map(([parameter, value, low, high, unit]) => {
        const [middle, error] = textsOf({ value, low, high, unit });
        return html`<li>${several && `${name}: `}<b>${parameter}</b> ${middle} <span class="muted">${error || "interval unknown"}</span></li>`;
      })}</ul>`}`)}`;
}

/** A picture that the server may have to draw first. */
export function Picture({ path, title }) {
  const [picture, setPicture] = useState(null), [failure, setFailure] = useState("");
  useEffect(() => {
    let address = null, isOld = false;
    fetchPicture(path).then((blob) => {
      if (isOld) return;
      address = URL.createObjectURL(blob);
      setPicture(address);
    }, (error) => setFailure(error.message));
    return () => {
      isOld = true;
      if (address) URL.revokeObjectURL(address);
    };
  }, [path]);
  if (failure) return html`<p class="note">${sentence(failure)}</p>`;
  return picture ? html`<img alt=${`Plot of ${title}`} src=${picture} />` : html`<p class="muted">It is being drawn …</p>`;
}
