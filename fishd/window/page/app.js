// The page: its state, what the stream says about it, the header with the E-stop, and the values.
import {
  call, duration, forceUnit, html, number, parametersText, recall, remember, render, sentence, setClient, timeOfDay, useState,
} from "./common.js";
import { About } from "./about.js";
import { Camera } from "./camera.js";
import { ChartTools, MarkForm } from "./chart_tools.js";
import { Charts } from "./charts.js";
import { Drive, driverName, request } from "./controls.js";
import { Experiments, plain, titleOf, triedThrust } from "./experiments.js";
import { defaultOf } from "./fields.js";
import { TopView } from "./fish.js";
import { QueueLine } from "./queue.js";
import { Ring, ticksOf } from "./ring.js";
import { Runs } from "./runs.js";
import { Stream } from "./stream.js";
import { Health, thrustTexts, Values } from "./values.js";

const byId = (id) => document.getElementById(id);
const STALE_S = 0.8;
const STALE_TICKS = 5;
/** Time without a message after which an emergency stop may not reach fishd-window. */
const SILENT_S = 2;
const CHECK_MS = 200;
const VALUES_MS = 250;
/**
 * Longest wait for the answer to an emergency stop, and pause until it is sent again: at first, and at most.
 * fishd-window needs 2 s without fishd, longer on a busy machine.
 */
const ESTOP_TIMEOUT_MS = [5000, 15_000];
const ESTOP_RETRY_MS = [250, 2000];
const NOTICE_MS = { info: 6_000, warning: 20_000, error: 20_000 };
const MAX_EVENTS = 100;
/** Beginning of the name of the lease under which a page drives. */
const OWN_LEASE = "window: ";
/** Parts of the page, by the last part of its address. */
const PLACES = { live: "Live", experiments: "Experiments", runs: "Runs", fish: "Fish" };

const state = {
  name: "", fish: [], session: null, status: null, controllers: [], events: [], jobs: new Map(),
  connection: null, driver: null, linked: false, helloed: false, refused: "", lastTick: null, tick: null, interval: 0.05,
  changedSeq: 0, own: new Set(), selected: null, edited: null, keep: recall("keep", false), estop: null,
  notices: [], reference: null, isCameraOpen: recall("camera", false), heard: performance.now(),
};
let ring = new Ring(0.05), charts, view, stream, drawing = false, valuesAt = 0, later = 0;
/** Number of connections in a row that ended without a first message. */
let failures = 0;

// ---- what the server says ----

const receive = {
  hello(payload) {
    failures = 0;
    setClient(payload.client);
    stream.client = payload.client;
    remember("client", payload.client, "sessionStorage");
    Object.assign(state, {
      name: payload.name, fish: payload.fish, session: payload.session, controllers: payload.controllers ?? [],
      events: payload.events ?? [], connection: payload.connection, driver: payload.driver, linked: true, helloed: true, refused: "",
      jobs: new Map((payload.jobs ?? []).map((job) => [job.id, job])),
      reference: recall(`reference.${payload.name}`, null), changedSeq: 0,
    });
    if (state.estop?.phase === "done" && payload.status?.mode !== "estop") state.estop = null;
    ring = new Ring(payload.status?.tick ?? 0.05);
    state.tick = state.lastTick = null;
    charts.setRing(ring);
    charts.marks.length = 0;
    for (const event of state.events) markEvent(event);
    setStatus(payload.status);
    document.body.classList.remove("waiting");
    changed();
  },
  /** Take a part of ten minutes: the extremes of bins. */
  past(columns) {
    for (const row of ticksOf(columns)) ring.past.add(row.time, row);
  },
  /** Take a part of the history. */
  history(columns) {
    for (const tick of ticksOf(columns)) ring.push(tick);
    state.tick = ring.latest;
    const age = state.connection?.age;
    state.lastTick ??= Number.isFinite(age) ? performance.now() - 1000 * age : null;
    charts.dirty = true;
    changed();
  },
  ticks(ticks) {
    const now = performance.now();
    if (state.lastTick !== null) {
      const each = (now - state.lastTick) / 1000 / ticks.length;
      if (each < 2) state.interval += 0.05 * (each - state.interval);
    }
    for (const tick of ticks) ring.push(tick);
    const before = state.tick;
    state.tick = ticks.at(-1);
    state.lastTick = now;
    charts.advance();
    if (before?.mode !== state.tick.mode && state.status) state.status = { ...state.status, mode: state.tick.mode };
    schedule();
    checkConnection();
  },
  event(event) {
    state.events = [...state.events.slice(1 - MAX_EVENTS), event];
    markEvent(event);
    if (event.kind === "controller" || event.kind === "parameters" || event.kind === "fallback") {
      const { controller, parameters } = event.data;
      setStatus({ ...state.status, controller, parameters });
      // The answer to a request of this page may come after its event.
      setTimeout(() => noticeOther(event), 1000);
    }
    if (event.kind === "mode") {
      if (event.data.mode !== "estop" && state.estop?.phase === "done") state.estop = null; // another client cleared it
      noticeOther(event);
    }
    if (event.kind === "sockets") notice(event.level, event.message);
    if (event.kind === "lease" && event.data.lease === "taken" && !event.data.name.startsWith(OWN_LEASE)) {
      notice("info", `the experiment ${event.data.name} holds the fish`);
    }
    changed();
  },
  status(status) {
    const kept = state.status && status.seq < state.changedSeq
      ? { controller: state.status.controller, parameters: state.status.parameters, mode: state.status.mode, reason: state.status.reason }
      : {};
    setStatus({ ...status, ...kept });
  },
  job(job) {
    const before = state.jobs.get(job.id);
    if (job.state === "dismissed") state.jobs.delete(job.id);
    else state.jobs.set(job.id, job);
    if (before?.state === "running" && job.state !== "running") {
      notice(job.state === "failed" ? "error" : "info", `${titleOf(state, job.kind)}: ${job.state}`, job.state === "failed" || job.kind === "queue" ? plain(job.lines?.at(-1) ?? "") : "");
    }
    changed();
  },
  driver(driver) {
    if (state.driver?.you_drive && driver && !driver.you_drive) notice("warning", `${driverName({ ...state, driver })} drives now.`);
    state.driver = driver;
    changed();
  },
  connection(connection) {
    if (connection.state === "restarted") {
      notice("warning", connection.message || "fishd was restarted.", "Its controller and parameters are those of a start.");
      state.changedSeq = 0;
    }
    state.connection = connection;
    checkConnection();
    changed();
  },
};

function setStatus(status) {
  if (!status) return;
  state.status = status;
  document.title = `${shownName()} · fishd`;
  charts.setStatus(status, state.controllers.find(({ name }) => name === status.controller));
  changed();
}

/** Return the name of the fish: that of the window's configuration, else the one that fishd has in its status. */
const shownName = () => (state.fish.length > 1 || state.name !== "fish" ? state.name : state.status?.name ?? state.name);

/** Return the parameters that are not the defaults. */
function ownText(name, parameters) {
  const fields = state.controllers.find((controller) => controller.name === name)?.parameters ?? [];
  const standard = Object.fromEntries(fields.map((field) => [field.name, defaultOf(field)]));
  return parametersText(Object.fromEntries(Object.entries(parameters ?? {}).filter(([key, value]) => value !== standard[key])));
}

let markedParameters = {};
/** Return the parameters that changed since the event before, also back to a default. */
function changeText(parameters) {
  const before = markedParameters;
  markedParameters = parameters;
  return Object.entries(parameters).filter(([key, value]) => value !== before[key])
    .map(([key, value]) => parametersText({ [key]: value }) || `${key}=default`).join(" ") || "parameters";
}

function markEvent(event) {
  const { controller, parameters } = event.data ?? {};
  if (event.kind === "controller" || event.kind === "fallback") markedParameters = parameters;
  const text = {
    controller: () => controller, fallback: () => `${controller} took over`, parameters: () => changeText(parameters),
    mark: () => event.message, fault: () => "fault",
    mode: () => (event.data.mode === "estop" ? "E-stop" : event.data.mode === "idle" ? "idle" : null),
  }[event.kind]?.();
  if (text) charts.mark(event.time, text);
}

function noticeOther(event) {
  const { controller, parameters, mode } = event.data;
  if (event.kind === "mode") {
    if (mode === "estop" && !state.estop) notice("error", "Another client used the E-stop.");
    return;
  }
  if (state.own.has(JSON.stringify([controller, parameters])) || experimentOf(state.status)) return;
  if (event.kind === "fallback") notice("warning", event.message);
  else notice("warning", `Another client set ${controller} ${ownText(controller, parameters)}`.trim() + ".");
}

// ---- how fresh it is: by this page's own clock, whatever the server says ----

function freshness() {
  const age = state.lastTick === null ? NaN : (performance.now() - state.lastTick) / 1000;
  if (state.session?.paired === false) return { kind: "not paired", age };
  if (!state.helloed && !state.refused) return { kind: "connecting", age };
  if (state.refused) return { kind: "lost", age, message: state.refused };
  if (!state.linked) return { kind: "lost", age, message: "fishd-window does not answer; the page tries again each second." };
  const said = state.connection?.state;
  if (said === "lost") return { kind: "lost", age, message: state.connection.message || "fishd does not answer." };
  if (!(age <= Math.max(STALE_S, STALE_TICKS * state.interval)) || said === "stale") {
    return { kind: "stale", age, message: state.connection?.message || "No ticks arrive." };
  }
  return { kind: "live", age };
}

/** Return why an emergency stop may not arrive; empty if its path has answered lately, and after a stop that was confirmed. */
function estopWarning() {
  if (state.session?.paired === false || state.estop?.phase === "done") return "";
  const silence = (performance.now() - state.heard) / 1000;
  return silence > SILENT_S ? `fishd-window has not answered for ${duration(silence)}` : state.connection?.warning ?? "";
}

let shownKind = "", shownWarning = "";
function checkConnection() {
  const { kind, message } = freshness();
  const warning = estopWarning();
  document.body.classList.toggle("unreachable", warning !== "");
  if (warning !== shownWarning) {
    if (!shownWarning) say("The emergency stop may not reach the fish.");
    shownWarning = warning;
    changed();
  }
  document.body.classList.toggle("stale", kind !== "live");
  document.body.classList.toggle("unpaired", kind === "not paired");
  if (kind !== shownKind) {
    shownKind = kind;
    say(kind === "live" ? "Connection live." : (message ?? "Connecting."));
    changed();
  } else if (kind !== "live") {
    renderHead();
    renderValues();
  }
}

function say(text) {
  byId("said").textContent = text;
}

// ---- requests ----

let notices = 0;
/** action: what can be done about it: text of a button, and function */
function notice(level, message, remedy = "", action = null) {
  const one = { id: ++notices, level, message: sentence(message), remedy: sentence(remedy), action };
  state.notices = [...state.notices.slice(-3), one];
  setTimeout(() => dismiss(one.id), NOTICE_MS[level]);
  changed();
}

function dismiss(id) {
  state.notices = state.notices.filter((one) => one.id !== id);
  changed();
}

/** Send a request of the driver; take the role first if no page has it. Show why it was refused; return whether it was carried out. */
async function act(op, args, take = false) {
  try {
    if (!state.driver?.you_drive && op !== "stop") await becomeDriver(take);
    const result = await request(state.name, "request", { op, args, take });
    if (result && "controller" in result) {
      const { seq, mode, reason, controller, parameters } = result;
      state.own.add(JSON.stringify([controller, parameters]));
      if (state.own.size > 50) state.own.delete(state.own.values().next().value);
      state.changedSeq = Math.max(state.changedSeq, seq);
      setStatus({ ...state.status, mode, reason, controller, parameters });
      if (result.previous_holder && !result.previous_holder.name.startsWith(OWN_LEASE)) notice("warning", `The experiment ${result.previous_holder.name} has lost the fish to this request.`);
    }
    if (op === "tare") notice("info", "The present force is zero now.");
    if (op === "clear-fault") state.estop = null;
    changed();
    return true;
  } catch (error) {
    const remedies = { driven: "Take over", "not-driver": "Take over", leased: "Take the fish" };
    notice("error", error.message, error.remedy, remedies[error.code] && [remedies[error.code], () => act(op, args, true)]);
    return false;
  }
}

/**
 * Take the driver's role, or change whether the fish swims on without this page.
 * The stream says who drives: the answer may come after a later change.
 */
const becomeDriver = (take = false) => request(state.name, "drive", { take, keep: state.keep });

async function changeRole(drives, take) {
  try {
    if (drives) await becomeDriver(take);
    else await request(state.name, "release", {});
  } catch (error) {
    notice("error", error.message, error.remedy);
  }
  changed();
}

/** Return the experiment that drives; a page of this window holds a lease, too, which is not one. */
const experimentOf = (status) => (status?.lease && !status.lease.name.startsWith(OWN_LEASE) ? status.lease : null);

// ---- emergency stop ----

const wait = (ms) => new Promise((done) => setTimeout(done, ms));

const doubled = ([first, most], times) => Math.min(most, first * 2 ** times);

/** Send the emergency stop until it is confirmed or refused; measure from the press to the answer. */
async function pressEstop() {
  const press = (state.estop = { phase: "sending", begin: performance.now(), attempts: 0 });
  say("Emergency stop sent.");
  changed();
  while (state.estop === press) {
    press.attempts++;
    try {
      const fish = state.name || nameInAddress() || (await call("GET", "/api/fish"))[0].name;
      const { server_ms: serverMs, way, outcome } = await call("POST", `/api/fish/${encodeURIComponent(fish)}/estop`, {}, doubled(ESTOP_TIMEOUT_MS, press.attempts - 1));
      Object.assign(press, { phase: "done", ms: performance.now() - press.begin, serverMs, way, outcome });
      say(`Emergency stop confirmed after ${number(press.ms, 0)} milliseconds.`);
      break;
    } catch (error) {
      // The window says that fishd is silent, so the window itself answers.
      const { message, remedy } = error.code === "no-answer" && state.linked && ["stale", "lost"].includes(state.connection?.state)
        ? { message: "fishd has not answered fishd-window yet", remedy: "" } : error;
      Object.assign(press, { phase: "failed", message, remedy, isLast: [401, 403, 404].includes(error.status) });
      changed();
      if (press.isLast) break;
      await wait(doubled(ESTOP_RETRY_MS, press.attempts - 1));
    }
  }
  changed();
}

function forgetEstop() {
  state.estop = null;
  changed();
}

let pressedAt = -Infinity;
for (const kind of ["pointerdown", "click"]) {
  byId("estop").addEventListener(kind, (event) => {
    if (event.button > 0 || (kind === "click" && performance.now() - pressedAt < 1000 && event.detail > 0)) return;
    pressedAt = performance.now();
    pressEstop();
  });
}

// ---- what is on the screen ----

const nameInAddress = () => new URLSearchParams(location.search).get("fish") ?? "";

function Head() {
  const { kind, age, message } = freshness();
  const mode = state.status?.mode ?? "unknown", modeText = mode === "estop" ? "E-stop" : mode;
  const lease = experimentOf(state.status);
  const [thrust, error, unit] = thrustTexts(state);
  const driver = lease ? `${lease.name} drives` : state.driver ? (state.driver.you_drive ? "you drive" : `${driverName(state)} drives`) : "no driver";
  return html`
    ${state.fish.length > 1
      ? html`<nav class="tabs" aria-label="Fish"><h1 class="unseen">${state.name}</h1>${state.fish.map((name) => html`<a href=${`?fish=${encodeURIComponent(name)}#${state.place}`}
          aria-current=${name === state.name ? "page" : undefined}>${name}</a>`)}</nav>`
      : html`<h1>${shownName() || "fishd"}</h1>`}
    ${kind !== "not paired" && html`<span class=${`pill mode ${mode}`} id="mode">${kind === "lost" && state.status ? `was ${modeText}` : modeText}</span>`}
    <span class=${`pill connection ${kind}`} id="connection" title=${message ?? ""}>
      <span class="dot"></span>${kind === "live" ? "live" : kind} <span class="age">${kind === "connecting" || kind === "not paired" ? "" : Number.isFinite(age) ? duration(age) : "no tick yet"}</span></span>
    ${kind !== "not paired" && html`<span id="thrust" title="Thrust, with its 95 % interval"><b>${thrust}</b> ${error} ${unit}</span>
      <span class="driver" id="driver">${driver}</span>`}`;
}

function Banner() {
  const { estop, status, session } = state;
  const mode = status?.mode;
  const { kind, message } = freshness();
  const warning = estopWarning(), isOld = kind === "lost" || kind === "stale";
  const reason = status?.reason;
  const latched = mode === "estop" || mode === "fault";
  return html`
    ${(session?.paired === false || state.invitation) && html`<${Pairing} />`}
    ${warning && html`<div class="banner warn" id="unreachable"><b>The E‑stop may not reach the fish.</b>
      <span>To stop it now, use the button of the panel, or run fishctl estop on its computer. ${sentence(warning)}${isOld && " What is greyed is old."}</span></div>`}
    ${isOld && !warning && html`<div class="banner warn"><b>${kind === "lost" ? "Connection lost." : "Stale."}</b>
      <span>${sentence(message)} What is greyed is old.</span></div>`}
    ${(status?.control === "" || status?.lease_expiry?.code === "unreachable") && html`<div class="banner warn" id="sockets">
      <b>${status.lease_expiry?.code === "unreachable" ? "fishd has let the fish rest." : "No further client can connect to fishd."}</b>
      <span>${status.control === "" ? sentence(status.limitations.at(-1)) : sentence(status.lease_expiry.message)} ${sentence(status.lease_expiry?.remedy)}</span></div>`}
    ${estop?.phase === "sending" && html`<div class="banner bad"><b>Emergency stop sent …</b></div>`}
    ${estop?.phase === "failed" && html`<div class="banner bad" role="alert"><b>Emergency stop NOT confirmed.</b>
      <span>${sentence(estop.message)} Sent ${estop.attempts === 1 ? "once" : `${estop.attempts} times`}. Use the button of the panel, or: fishctl estop. ${sentence(estop.remedy)}</span>
      <button type="button" onClick=${forgetEstop}>${estop.isLast ? "Close" : "Do not send it again"}</button></div>`}
    ${(latched || estop?.phase === "done") && html`<div class="banner bad" id="latched">
      <div>${mode === "fault" ? html`<b>Fault.</b>` : html`<b>Emergency stop.</b>`}
        ${estop?.phase === "done" && html` <span>Confirmed <b id="estop-ms">${number(estop.ms, 0)} ms</b> after the press${
          Number.isFinite(estop.serverMs) && html` (${number(estop.serverMs, 1)} ms of it in fishd-window and fishd)`}.
          ${estop.way === "last resort" ? ` fishd did not answer; without it: ${estop.outcome}.` : !latched && " The stream has not shown it yet."}</span>`}
        ${reason && html`<p>${sentence(reason.message)}${reason.remedy && html` <span class="remedy">Before you clear it: ${reason.remedy}.</span>`}</p>`}</div>
      ${latched && html`<button type="button" id="clear-fault" disabled=${session?.scope !== "drive"} onClick=${() => act("clear-fault", {})}>Clear fault</button>`}
    </div>`}
    ${mode === "running" && status.fallback && html`<div class="banner warn"><b>Fallback.</b> <span>${sentence(status.fallback.message)}</span></div>`}
    ${status?.sensor_lost && html`<div class="banner warn"><b>No force can be trusted.</b> <span>The thrust is the last known one.</span></div>`}
    ${status?.servo_lost && html`<div class="banner bad"><b>The servo cannot be reached.</b> <span>${status.servo_on && "It may still get pulses."}</span></div>`}`;
}

function Pairing() {
  const { invitation } = state;
  const [typed, setToken] = useState(""), [name, setName] = useState(""), token = invitation || typed;
  const send = async (event) => {
    event.preventDefault();
    await pair(token.trim(), name.trim());
  };
  return html`<form class="banner pairing" onSubmit=${send}>
    <b>${invitation ? "Pair this device." : `This device is ${state.helloed ? "no longer" : "not"} paired.`}</b>
    <span>${invitation ? "Give it a name: by that it is listed, and revoked." : "Run fishctl window pair on the fish's computer, then open its link here, or type its last part, after #pair=."}</span>
    ${!invitation && html`<label>Code <input value=${token} required autocomplete="one-time-code" onInput=${(event) => setToken(event.target.value)} /></label>`}
    <label>Name of this device <input value=${name} required placeholder="tablet at the tank" maxlength="40" autocomplete="off" onInput=${(event) => setName(event.target.value)} /></label>
    <button class="primary">Pair</button></form>`;
}

async function pair(token, name) {
  try {
    await call("POST", "/api/pair", { token, name });
    location.reload();
  } catch (error) {
    notice("error", error.message, error.remedy);
  }
}

function setReference() {
  const { thrust, thrust_ci95: half = null, controller } = state.tick;
  if (!(thrust > 0)) return notice("warning", "only a thrust above zero can be 100 %");
  state.reference = { thrust, half, text: `${controller} ${timeOfDay(state.tick.t)}` };
  remember(`reference.${state.name}`, state.reference);
  return changed();
}

function Events() {
  const events = state.events.slice().reverse();
  return html`<h2 id="events-title">Events</h2>
    ${events.length === 0 ? html`<p class="muted">None yet.</p>` : html`<ol class="events" tabindex="0" aria-label="Latest events first">
      ${events.map((event) => html`<li key=${`${event.t}${event.kind}`} class=${event.level}><time>${timeOfDay(event.t)}</time>
        <span class="kind">${event.kind}</span><span>${event.message}</span></li>`)}</ol>`}
    ${state.status?.limitations?.map((line) => html`<p class="foot">Limitation: ${line}.</p>`)}
    ${state.session && !state.session.loopback && state.session.paired && html`<p class="foot">Paired as ${state.session.device || "this device"}.${" "}
      <button type="button" class="link" onClick=${() => call("POST", "/api/unpair", {}).then(() => location.reload())}>Forget this device</button></p>`}`;
}

const Notices = () => state.notices.map((one) => html`<div key=${one.id} class=${`notice ${one.level}`}>
  <span>${one.message} ${one.remedy && html`<span class="remedy">${one.remedy}</span>`}</span>
  ${one.action && html`<button type="button" onClick=${() => {
    dismiss(one.id);
    one.action[1]();
  }}>${one.action[0]}</button>`}
  <button type="button" aria-label="Dismiss" onClick=${() => dismiss(one.id)}>×</button></div>`);

const renderHead = () => render(html`<${Head} />`, byId("head"));
const renderValues = () => (state.place === "fish" ? render(html`<${Health} state=${state} ring=${ring} />`, byId("health"))
  : state.place === "live" && render(html`<${Values} ...${{ state, ring, ownText, setReference }} />`, byId("cards")));

function Places() {
  const running = [...state.jobs.values()].filter((job) => job.state === "running").length;
  return Object.entries(PLACES).map(([place, title]) => html`<a href=${`#${place}`} aria-current=${place === state.place ? "page" : undefined}>${title}
    ${place === "experiments" && running > 0 && html` <span class="pill small running">${running}</span>`}</a>`);
}

function renderAll() {
  const shared = { state, act, notice, changed, changeRole, becomeDriver, experiment: experimentOf(state.status) };
  renderHead();
  render(html`<${Places} />`, byId("places"));
  renderValues();
  render(state.name && state.isCameraOpen ? html`<${Camera} fish=${state.name} close=${() => showCamera(false)} />` : null, byId("camera"));
  byId("show-camera").hidden = state.isCameraOpen;
  render(state.place === "fish" && state.name ? html`<${About} fish=${state.name} isPaired=${state.session?.paired} act=${act}
    mayRestart=${state.session?.scope === "drive" && state.status?.mode !== "running"} />` : null, byId("about"));
  render(html`<${Banner} />`, byId("banner"));
  render(html`<${Drive} ...${shared}><${QueueLine} page=${shared} /><//>`, byId("drive"));
  render(html`<${ChartTools} ...${{ charts, shownName }} />`, byId("chart-head"));
  render(charts.cursor !== null && html`<${MarkForm} ...${{ charts, state, act }} />`, byId("chart-foot"));
  render(html`<${Experiments} ...${shared} />`, byId("experiments"));
  render(html`<${Runs} ...${shared} />`, byId("runs"));
  render(html`<${Events} />`, byId("events"));
  render(html`<${Notices} />`, byId("notices"));
}

function showCamera(isOpen) {
  state.isCameraOpen = isOpen;
  remember("camera", isOpen);
  renderAll();
  if (!isOpen) byId("show-camera").focus();
}

let renderNeeded = false, saidMode = "";
function changed() {
  renderNeeded = true;
  schedule();
}

function schedule() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(drawFrame);
}

function drawFrame(now) {
  drawing = false;
  if (renderNeeded) {
    renderNeeded = false;
    renderAll();
    valuesAt = now;
  } else if (now - valuesAt > VALUES_MS) {
    valuesAt = now;
    renderHead();
    renderValues();
  }
  const mode = state.status?.mode;
  if (mode && mode !== saidMode) {
    saidMode = mode;
    say(`Mode ${mode}.`);
  }
  charts.setVirtual(triedThrust(state));
  charts.draw(now);
  if (state.place === "live") view.draw(state.tick);
  const tail = !state.tick ? "tail" : state.tick.alpha === undefined ? "tail, as commanded" : "tail, true";
  if (byId("tail-key").textContent !== tail) byId("tail-key").textContent = tail;
  if (!charts.dirty || later) return;
  later = setTimeout(() => {
    later = 0;
    schedule();
  }, charts.waitMs(now));
}

function buildStaticParts() {
  render(html`<h2 id="view-title" class="unseen">From above</h2><canvas id="fish" role="img"
      aria-label="The fish from above; its tail shows the command, and the true fin if it is simulated"></canvas>
    <p class="keys"><span class="key-phi">command φ<sub>c</sub></span><span class="key-body" id="tail-key">tail</span></p>
    <p class="keys"><button type="button" class="link" id="show-camera" onClick=${() => showCamera(true)}>show the camera</button></p>`, byId("view"));
  view = new TopView(byId("fish"));
  const banner = byId("banner"), header = document.querySelector("header");
  const noteHeights = new ResizeObserver(() => {
    document.documentElement.style.setProperty("--banner", `${banner.offsetHeight}px`);
    document.documentElement.style.setProperty("--header", `${header.offsetHeight}px`);
  });
  noteHeights.observe(banner);
  noteHeights.observe(header);
  charts = new Charts(byId("plots"), { changed, say });
  charts.setRing(ring);
}

/** Show the place in the address; take the token of an invitation from there, for which the page asks a name. */
function followAddress() {
  const token = new URLSearchParams(location.hash.slice(1)).get("pair");
  if (token) {
    state.invitation = token;
    history.replaceState(null, "", location.pathname + location.search);
  }
  if (location.hash === "#camera") state.isCameraOpen = true; // from `fishctl camera page`
  const place = PLACES[location.hash.slice(1)] ? location.hash.slice(1) : "live", isOther = state.place && state.place !== place;
  state.place = place;
  for (const section of byId("main").children) section.hidden = !section.dataset.places.split(" ").includes(place);
  byId("main").dataset.place = place;
  if (isOther) scrollTo(0, 0); // not as far down as the part before
  changed();
}

async function start() {
  buildStaticParts();
  renderAll();
  setInterval(checkConnection, CHECK_MS);
  addEventListener("hashchange", followAddress);
  followAddress();
  for (;;) {
    try {
      state.session = await call("GET", "/api/session");
      break;
    } catch (error) {
      say(error.message);
      await wait(1000);
    }
  }
  changed();
  if (state.session.paired === false) return;
  const before = recall("client", "", "sessionStorage"); // a page that is loaded again goes on driving
  stream = new Stream(nameInAddress(), before, take, noteClosed);
}

/** Take a message of the server. */
function take(type, payload) {
  state.heard = performance.now();
  receive[type]?.(payload);
}

/** Find out why the connection has ended: no server, a device that was revoked, or too many pages. */
async function noteClosed() {
  state.linked = false;
  failures++;
  checkConnection();
  changed();
  const session = await call("GET", "/api/session").catch(() => null);
  if (state.linked) return;
  if (session) Object.assign(state, { session, heard: performance.now() });
  if (session?.paired && failures > 1) state.refused = "fishd-window refuses this page, maybe because too many are open; it is tried again";
  else state.refused = "";
  changed();
}

export { charts, receive, state, stream };
start();
