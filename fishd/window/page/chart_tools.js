// What is above the charts: pause and span, the choice of charts, a picture of them, and a mark at the cursor.
import { savePicture } from "./chart_picture.js";
import { html, timeOfDay, useState } from "./common.js";
import { KEYS_HELP, ZOOM } from "./gestures.js";

const WINDOWS = [15, 30, 60, 120, 300, 600];
const PAN = 0.5;

const lengthText = (seconds) => (seconds > 120 && seconds % 60 === 0 ? `${seconds / 60} min` : `${+seconds.toPrecision(2)} s`);
const tool = (name, text, run, isOff = false) =>
  html`<button type="button" aria-label=${name} title=${name} disabled=${isOff} onClick=${run}>${text}</button>`;

export function ChartTools({ charts, shownName }) {
  const [isOpen, setOpen] = useState(false);
  const { view, actions, arrangement } = charts, { seconds } = view;
  const lengths = WINDOWS.includes(seconds) ? WINDOWS : [...WINDOWS, seconds].sort((one, other) => one - other);
  const row = (chart, index, all) => html`<li key=${chart.key}>
    <label><input type="checkbox" checked=${!arrangement.hidden.includes(chart.key)}
      onChange=${(event) => charts.arrange(() => arrangement.show(chart.key, event.target.checked))} /> ${chart.text}</label>
    ${[[-1, "up", "↑", 0], [1, "down", "↓", all.length - 1]].map(([by, word, arrow, last]) => tool(`Move ${chart.text} ${word}`, arrow,
      () => charts.arrange(() => arrangement.move(charts.available, chart.key, by)), index === last))}</li>`;
  return html`<div class="head-row"><h2 id="charts-title">Live</h2>
      <span class="keys"><span class="key-suspect">suspect sample</span><span class="key-gap">no ticks</span><span class="key-mark">change</span></span>
      <output id="chart-time" class="muted" aria-live="off"></output></div>
    <div class="chart-tools" role="group" aria-label="View of the charts">
      <button type="button" id="pause" class=${view.isLive ? "" : "primary"} onClick=${actions.pause}>${view.isLive ? "Pause" : "Follow"}</button>
      <span class="together">${tool("Earlier", "‹", () => actions.pan(-PAN))}${tool("Later", "›", () => actions.pan(PAN), view.isLive)}</span>
      <span class="together">${tool("Zoom out", "−", () => actions.zoom(ZOOM))}
        <select id="seconds" aria-label="Length of the view" value=${seconds} onChange=${(event) => charts.setSeconds(Number(event.target.value))}>
          ${lengths.map((length) => html`<option value=${length}>${lengthText(length)}</option>`)}</select>
        ${tool("Zoom in", "+", () => actions.zoom(1 / ZOOM))}</span>
      <button type="button" aria-expanded=${isOpen} aria-controls="chart-list" onClick=${() => setOpen(!isOpen)}>Charts</button>
      <button type="button" onClick=${() => savePicture(charts, shownName())}>Picture</button>
    </div>
    <p id="chart-help" class="unseen">${KEYS_HELP}</p>
    <ol id="chart-list" hidden=${!isOpen} aria-label="Charts, in their order">${isOpen && charts.available.map(row)}</ol>`;
}

/** A mark at the cursor, which a device sets that may drive. */
export function MarkForm({ charts, state, act }) {
  const [text, setText] = useState("");
  const { t, seq } = charts.cursorTick;
  const send = async (event) => {
    event.preventDefault();
    if (await act("mark", { text: `${text || "mark"} (tick ${seq})` })) charts.setCursor(null);
  };
  return html`<form id="mark-here" class="chart-tools" onSubmit=${send}>
    <span>${timeOfDay(t)}${seq !== null && `, tick ${seq}`}</span>
    ${state.session?.scope !== "drive" ? html`<span class="muted">This device may only watch: it cannot set a mark.</span>`
      : seq === null ? html`<span class="muted">Too old for a mark: its tick is no longer known.</span>`
      : html`<input aria-label="Text of the mark at the cursor" placeholder="text of a mark" maxlength="200" autocomplete="off" value=${text}
          onInput=${(event) => setText(event.target.value)} /><button>Mark here</button>`}
    <button type="button" onClick=${charts.actions.clear}>Remove cursor</button></form>`;
}
