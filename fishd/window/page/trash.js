// The trash: what was deleted in the last 30 days, its way back, and its end.
import { call, html, sentence, useEffect, useState } from "./common.js";
import { CHECK_TIMEOUT_MS } from "./forms.js";
import { restore } from "./run.js";

const date = new Intl.DateTimeFormat([], { dateStyle: "medium", timeStyle: "short" });

/** changes: number of changes of the runs until now; changed: notes another one */
export function Trash({ page, changes, changed }) {
  const [isOpen, setOpen] = useState(false), [deleted, setDeleted] = useState(null), [failure, setFailure] = useState("");
  useEffect(() => {
    if (isOpen) call("GET", "/api/trash").then((list) => {
      setDeleted(list);
      setFailure("");
    }, (error) => setFailure(error.message));
  }, [isOpen, changes]);
  const isOff = page.state.session?.scope !== "drive";
  return html`<div class="trash"><button type="button" class="link" aria-expanded=${isOpen} onClick=${() => setOpen(!isOpen)}>Trash</button>
    ${isOpen && (failure ? html`<p class="note">${sentence(failure)}</p>` : deleted === null ? html`<p class="muted">Loading …</p>`
      : deleted.length === 0 ? html`<p class="muted">It is empty. What is deleted stays here for 30 days.</p>`
        : html`<p class="muted">Kept for 30 days.</p>
          <ul>${deleted.map((run) => html`<li key=${run.id}><span>${run.name}</span> <span class="muted">deleted ${date.format(run.deleted * 1000)}</span>
            <button type="button" disabled=${isOff} aria-label=${`Restore ${run.name}`} onClick=${() => restore(page, run, changed)}>Restore</button></li>`)}</ul>
          <${Emptying} key=${deleted.length} ...${{ ids: deleted.map(({ id }) => id), page, changed, isOff }} />`)}</div>`;
}

/** The button that empties the trash, and asks first; where it was, a second press of it keeps all. */
function Emptying({ ids, page, changed, isOff }) {
  const [isAsking, setAsking] = useState(false);
  const empty = () => {
    setAsking(false);
    call("POST", "/api/trash/empty", { ids }, CHECK_TIMEOUT_MS).catch((error) => page.notice("error", error.message, error.remedy)).then(changed);
  };
  return html`<div class="buttons"><button type="button" disabled=${isOff} onClick=${() => setAsking(!isAsking)}>${isAsking ? "Keep" : "Empty trash"}</button>
    ${isAsking && html`<button type="button" class="stop" onClick=${empty}>Remove ${ids.length === 1 ? "this run" : `these ${ids.length} runs`} permanently</button>`}</div>`;
}
