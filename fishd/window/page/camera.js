// The camera's picture with the measured tail and the axis of motion, while the tile is open and on the screen.
import { html, interval, number, recall, remember, sentence, useEffect, useRef, useState } from "./common.js";

const RETRY_MS = 2000;
/** Colours of what is drawn into the picture, which is grey in light and dark. */
const TAIL = "#5aff78", AXIS = "#ff5a3c", CROP = "#5ac8ff";

/** The tile; `close` is called by its button. */
export function Camera({ fish, close }) {
  const canvas = useRef(null), link = useRef(null);
  const [facts, setFacts] = useState({ title: "Connecting", lines: [] });
  const [aligns, setAligns] = useState(recall("camera.align", false));
  useEffect(() => {
    link.current = new Link(canvas.current, fish, setFacts);
    link.current.setAligns(aligns);
    return () => link.current.close();
  }, [fish]);
  const align = (event) => {
    setAligns(event.target.checked);
    remember("camera.align", event.target.checked);
    link.current.setAligns(event.target.checked);
  };
  return html`<div class="head-row"><h2 id="camera-title">Camera</h2>
      <label class="special"><input type="checkbox" checked=${aligns} onChange=${align} /> show how it is aligned</label>
      <button type="button" onClick=${close}>Close</button></div>
    <div class=${`camera ${facts.is_lost ? "old" : ""}`}>
      <canvas ref=${canvas} width="4" height="3" role="img" aria-label="What the camera sees, with the measured tail"></canvas>
      <div><p role="status" class=${facts.is_lost ? "note" : "summary"}>${sentence(facts.title)}</p>
        ${facts.lines?.map((line) => html`<p class="muted">${sentence(line).replace(/ -(?=\d)/g, " −")}</p>`)}
        ${aligns && !facts.is_lost && html`<p class="muted">${facts.axis
          ? `The axis is ${number(facts.axis[0], 1)} px below the middle row of what frames show, tilted by ${number(facts.axis[1] * 180 / Math.PI, 1)}°.`
          : "The axis is not known yet: let the tail move for some seconds."}</p>
        <p class="keys"><span style=${{ "--key": AXIS }}>axis of motion</span><span style=${{ "--key": CROP }}>what frames show, and its middle row</span></p>`}
        <p class="keys"><span style=${{ "--key": TAIL }}>measured tail</span></p></div></div>`;
}

/** Connection for the pictures; it is closed while they are not on the screen, so that none is sent. */
class Link {
  constructor(canvas, fish, tell) {
    Object.assign(this, { canvas, fish, tell, isSeen: false, aligns: false, facts: {}, socket: null });
    this.observer = new IntersectionObserver(([entry]) => {
      this.isSeen = entry.isIntersecting;
      this.#look();
    });
    this.observer.observe(canvas);
    this.listener = () => this.#look();
    document.addEventListener("visibilitychange", this.listener);
  }

  close() {
    this.observer.disconnect();
    document.removeEventListener("visibilitychange", this.listener);
    this.isSeen = false;
    this.#look();
  }

  setAligns(aligns) {
    this.aligns = aligns;
    this.#send("align", aligns);
  }

  /** Open the connection if the picture is on the screen, else close it. */
  #look() {
    clearTimeout(this.retry);
    const isWanted = this.isSeen && !document.hidden;
    if (isWanted && !this.socket) this.#connect();
    if (!isWanted) {
      const { socket } = this;
      this.socket = null;
      socket?.close();
    }
  }

  #connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = (this.socket = new WebSocket(`${scheme}://${location.host}/camera?fish=${encodeURIComponent(this.fish)}`));
    let picture = null, isOpen = false;
    socket.onopen = () => {
      isOpen = true;
      this.#send("align", this.aligns);
    };
    socket.onmessage = async ({ data }) => {
      if (typeof data !== "string") {
        await this.#draw(data, picture);
        this.#send("drawn");
        return;
      }
      const [kind, payload] = JSON.parse(data);
      if (kind === "picture") picture = payload;
      else this.tell(this.facts = payload);
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.socket = null;
      const title = isOpen ? "fishd-window does not answer" : "fishd-window sends no pictures: its settings name no camera for this fish, or too many pages show one";
      this.tell(this.facts = { title, is_lost: true });
      this.retry = setTimeout(() => this.#look(), RETRY_MS);
    };
  }

  #send(...message) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  async #draw(jpeg, picture) {
    const bitmap = await createImageBitmap(jpeg).catch(() => null);
    if (!bitmap) return;
    const { canvas } = this, context = canvas.getContext("2d");
    const width = Math.round(canvas.clientWidth * devicePixelRatio), height = Math.round(width * bitmap.height / bitmap.width);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    context.drawImage(bitmap, 0, 0, width, height);
    bitmap.close();
    const path = (points, colour, dash = []) => {
      context.setLineDash(dash);
      Object.assign(context, { strokeStyle: colour, lineWidth: 2 * devicePixelRatio, lineJoin: "round" });
      context.beginPath();
      for (const [x, y] of points) context.lineTo(x * width, y * height);
      context.stroke();
    };
    const { crop: [left, top, across, down], size: [columns, rows], midline, alpha, uncertainty, reason } = picture;
    if (this.aligns) {
      path([[left, top], [left + across, top], [left + across, top + down], [left, top + down], [left, top]], CROP);
      path([[left, top + down / 2], [left + across, top + down / 2]], CROP, [6, 8]);
    }
    if (this.aligns && this.facts.axis) {
      const [offset, tilt, size] = this.facts.axis, rise = 0.5 * Math.tan(tilt);
      path([-1, 1].map((side) => [left + across * (0.5 + 0.5 * side), top + down * (0.5 + offset / size + side * rise)]), AXIS);
    }
    path(midline.map(([x, y]) => [(x + 0.5) / columns, (y + 0.5) / rows]), TAIL);
    if (alpha === null && !reason) return;
    const text = [alpha !== null && `α ${uncertainty === null ? number(alpha, 3) : interval(alpha, uncertainty).join(" ")} rad`, reason].filter(Boolean).join(", ");
    Object.assign(context, { font: `600 ${13 * devicePixelRatio}px system-ui, sans-serif`, textBaseline: "bottom", lineWidth: 4 * devicePixelRatio, strokeStyle: "#000", fillStyle: "#fff" });
    context.setLineDash([]);
    const place = [text, 8 * devicePixelRatio, height - 6 * devicePixelRatio];
    context.strokeText(...place);
    context.fillText(...place);
  }
}
