// What all modules share: the template function, numbers as text, and requests to the server.
import { html } from "./vendor/htm-preact-standalone-3.1.1.js";

export { html, render, useEffect, useLayoutEffect, useMemo, useRef, useState } from "./vendor/htm-preact-standalone-3.1.1.js";

const NBSP = "\u00a0";
const REQUEST_TIMEOUT_MS = 20_000;
const PICTURE_TIMEOUT_MS = 120_000;

/** Return a number with a fixed number of decimals and a true minus sign; a dash if there is none. */
export function number(value, decimals) {
  if (!Number.isFinite(value)) return "–";
  const text = value.toFixed(decimals);
  return /[1-9]/.test(text) ? text.replace("-", "−") : text.replace("-", "");
}

/** Return a number with about this many significant digits. */
export function significant(value, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const decimals = Math.min(8, Math.max(0, digits - 1 - Math.floor(Math.log10(Math.abs(value)))));
  return number(value, decimals);
}

/** Return the decimals that show two digits of the smallest number, but not more than five of the largest. */
export function decimalsFor(smallest, largest) {
  const place = (x) => Math.floor(Math.log10(x));
  return Math.min(8, Math.max(0, Math.min(1 - place(smallest), 4 - place(largest))));
}

/** Return value and half-width of its interval, with the same decimals. */
export function interval(value, halfWidth) {
  if (!Number.isFinite(value)) return ["–", ""];
  if (!Number.isFinite(halfWidth) || halfWidth < 0) return [significant(value), `±${NBSP}?`];
  if (halfWidth <= 1e-6 * Math.abs(value)) return [significant(value, 4), "(exact)"];
  const decimals = decimalsFor(halfWidth, Math.max(halfWidth, Math.abs(value)));
  return [number(value, decimals), `±${NBSP}${number(Math.max(halfWidth, 10 ** -decimals), decimals)}`];
}

/** Return factor and name of the unit in which forces are shown: mN for newtons. */
export function forceUnit(status) {
  const unit = status?.force_unit ?? "N";
  return unit === "N" ? [1000, "mN"] : [1, unit];
}

/** Return the text of a unit; a pure number has none. */
export const unitText = (unit) => (unit && unit !== "1" ? unit : "");

/** Return a duration such as "0.8 s", "12 s", "3 min"; a rough one has decimals below a second only. */
export function duration(seconds, isRough = false) {
  if (!Number.isFinite(seconds)) return "–";
  if (seconds < (isRough ? 0.95 : 9.95)) return `${seconds.toFixed(1)}${NBSP}s`;
  if (seconds < 120) return `${seconds.toFixed(0)}${NBSP}s`;
  if (seconds < 7200) return `${(seconds / 60).toFixed(0)}${NBSP}min`;
  return `${(seconds / 3600).toFixed(1)}${NBSP}h`;
}

/** Return a message as a sentence: with a full stop and a capital letter, unless it begins with the name of a program. */
export const sentence = (text) => (text
  ? (/^fish(d|ctl)\b/.test(text) ? text[0] : text[0].toUpperCase()) + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".") : "");

/** Return the local time of day of a unix time. */
export const timeOfDay = (t) => new Date(t * 1000).toLocaleTimeString([], { hourCycle: "h23" });

/** Return the number in a text, also with a decimal comma; the text if it is not a number. */
export function numberIn(text) {
  const value = Number(text.replace(",", "."));
  return text.trim() === "" || !Number.isFinite(value) ? text : value;
}

/** Return parameters with their names: C=0.6 amplitude=0.4. */
export function parametersText(parameters) {
  return Object.entries(parameters ?? {})
    .filter(([, value]) => value !== null)
    .map(([name, value]) => `${name}=${typeof value === "number" ? +value.toPrecision(6) : value}`)
    .join(" ");
}

/** Return a controller with parameters as fishctl takes it: swing:C=0.6,lead=0.1. */
export function controllerText(name, parameters) {
  const values = parametersText(parameters).replaceAll(" ", ",");
  return values ? `${name}:${values}` : name;
}

/** Quote a word as a shell needs it. */
const quote = (word) => (/^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`);

/** A command line, which is broken between its words. */
export const Command = ({ words, label = "Command line" }) => html`<code tabindex="0" aria-label=${label}>${
  words.map((word) => html`<span>${quote(word)}</span> `)}</code>`;

/** Return a colour of the page by its name. */
export const colourOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

/** Draw a chart into a node, and keep it as wide as that; return it, and the function that removes it. */
export function drawPlot(node, { axes, ...options }, data) {
  const axis = { stroke: () => colourOf("muted"), font: "11px system-ui, sans-serif", ticks: { show: false }, grid: { stroke: () => colourOf("grid"), width: 1 } };
  const plot = new globalThis.uPlot({
    width: node.clientWidth, legend: { show: false }, cursor: { drag: { x: false, y: false } }, ...options, axes: axes.map((own) => ({ ...axis, ...own })),
  }, data, node);
  const watch = new ResizeObserver(([{ contentRect: { width } }]) => width > 0 && plot.setSize({ width, height: options.height }));
  watch.observe(node);
  return [plot, () => {
    watch.disconnect();
    plot.destroy();
  }];
}

/** An answer of the server that is not the result. */
export class Refusal extends Error {
  constructor({ code, message, remedy }, status) {
    super(message);
    Object.assign(this, { code, remedy: remedy ?? "", status });
  }
}

let clientId = "";
/** Set the identifier by which the server knows this page. */
export function setClient(id) {
  clientId = id;
}

/** Return the result of a request, which may be a picture, or raise `Refusal`. */
export async function call(method, path, body, timeout = REQUEST_TIMEOUT_MS) {
  const options = { method, signal: AbortSignal.timeout(timeout), cache: "no-store" };
  if (method === "POST") {
    options.headers = { "Content-Type": "application/json", "X-Client": clientId };
    options.body = JSON.stringify(body ?? {});
  }
  let reply, status;
  try {
    const response = await fetch(path, options);
    status = response.status;
    const isPicture = response.headers.get("Content-Type")?.startsWith("image/");
    reply = isPicture ? { ok: true, result: await response.blob() } : await response.json();
  } catch (error) {
    const message = status
      ? `fishd-window answered with status ${status} and no reason`
      : error.name === "TimeoutError"
        ? `fishd-window has not answered for ${duration(timeout / 1000)}`
        : "fishd-window does not answer";
    throw new Refusal({ code: "no-answer", message, remedy: "See whether fishd-window runs." }, status ?? 0);
  }
  if (!reply.ok) throw new Refusal(reply.error, status);
  return reply.result;
}

/** Return a picture, which the server may have to draw first, or raise `Refusal`. */
export const fetchPicture = (path) => call("GET", path, null, PICTURE_TIMEOUT_MS);

/** Read a value that this browser keeps, by default for all its tabs, or return the default. */
export function recall(key, standard, storage = "localStorage") {
  try {
    return JSON.parse(globalThis[storage].getItem(`fishd.${key}`)) ?? standard;
  } catch {
    return standard;
  }
}

/** Keep a value in this browser, unless its settings forbid that. */
export function remember(key, value, storage = "localStorage") {
  try {
    globalThis[storage].setItem(`fishd.${key}`, JSON.stringify(value));
  } catch {
    // The page works without it.
  }
}
