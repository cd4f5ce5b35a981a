// The trash: what was deleted in the last 30 days, and its way back.
import { call, html, sentence, useEffect, useState } from "./common.js";
import { restore } from "./run.js";

const date = new Intl.DateTimeFormat([], { dateStyle: "medium", timeStyle: "short" });

/** changes: number of changes of the runs until now; changed: notes another one */
export function Trash({ page, changes, changed }) {
  const [isOpen, setOpen] = useState(false), [deleted, setDeleted] = useState(null), [failure, setFailure] = useState("");
  useEffect(() => {
    if (isOpen) call("GET", "/api/trash").then(setDeleted, (error) => setFailure(error.message));
  }, [isOpen, changes]);
  return html`<div class="trash"><button type="button" class="link" aria-expanded=${isOpen} onClick=${() => setOpen(!isOpen)}>Trash</button>
    ${isOpen && (failure ? html`<p class="note">${sentence(failure)}</p>` : deleted === null ? html`<p class="muted">Loading …</p>`
      : deleted.length === 0 ? html`<p class="muted">It is empty. What is deleted stays here for 30 days.</p>`
        : html`<p class="muted">Kept for 30 days. To free the space now: fishctl runs trash --empty</p>
          <ul>${deleted.map((run) => html`<li key=${run.id}><span>${run.name}</span> <span class="muted">deleted ${date.format(run.deleted * 1000)}</span>
            <button type="button" disabled=${page.state.session?.scope !== "drive"} aria-label=${`Restore ${run.name}`}
              onClick=${() => restore(page, run, changed)}>Restore</button></li>`)}</ul>`)}</div>`;
}
