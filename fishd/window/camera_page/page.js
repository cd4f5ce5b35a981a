// Shows pictures and facts as they come over the WebSocket, the axis of motion drawn in.
"use strict";

const AGAIN = 1000;   // after a lost connection [ms]
const byId = (id) => document.getElementById(id);
const canvas = byId("picture");
const context = canvas.getContext("2d");
const style = getComputedStyle(document.documentElement);

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => take(event.data);
  socket.onclose = () => {
    tell({ state: "lost", problem: "the page's server does not answer; it is tried again" });
    setTimeout(connect, AGAIN);
  };
}

async function take(message) {
  const length = new DataView(message).getUint32(0);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  tell(facts);
  if (message.byteLength > 4 + length) {
    const jpeg = new Blob([new Uint8Array(message, 4 + length)], { type: "image/jpeg" });
    draw(await createImageBitmap(jpeg), facts);
  }
}

function tell(facts) {
  const state = byId("state");
  state.textContent = facts.state;
  state.className = `pill ${facts.state}`;
  document.body.classList.toggle("stale", facts.state !== "streaming");
  const words = [facts.problem, facts.remedy].filter(Boolean).join("; ");
  byId("problem").textContent = words;
  byId("problem").hidden = !words;
  if (facts.device === undefined) return;
  byId("device").textContent = facts.device;
  byId("rate").textContent = `${facts.rate.toFixed(1)} frames a second`;
  if (facts.seq === undefined) return;
  byId("seq").textContent = facts.seq;
  byId("age").textContent = `${(facts.age * 1e3).toFixed(0)} ms`;
  byId("lost").textContent = `${facts.dropped} by the camera, ${facts.missed} on the way`;
  byId("axis").textContent = facts.axis
    ? `${signed(facts.axis.offset)} px, ${signed(facts.axis.tilt * 180 / Math.PI)}°` +
      (facts.moving ? "" : ", as it was while the tail moved")
    : "not known yet: the tail must move for some seconds";
}

const signed = (value) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(1);

function draw(image, facts) {
  const scale = Math.max(1, Math.floor(640 / image.width));
  canvas.width = image.width * scale;
  canvas.height = image.height * scale;
  context.imageSmoothingEnabled = false;
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  image.close();
  const { crop, size, axis } = facts;
  if (!crop) return;
  const left = crop.left * canvas.width, top = crop.top * canvas.height;
  const width = crop.width * canvas.width, height = crop.height * canvas.height;
  context.lineWidth = Math.max(2, canvas.width / 320);
  if (crop.width < 1 || crop.height < 1) {
    context.strokeStyle = style.getPropertyValue("--crop");
    context.strokeRect(left, top, width, height);
  }
  if (!axis) return;
  const row = (column) => 0.5 * (size - 1) + axis.offset + (column - 0.5 * (size - 1)) * Math.tan(axis.tilt);
  const y = (column) => top + (row(column) + 0.5) / size * height;
  context.strokeStyle = style.getPropertyValue("--axis");
  context.beginPath();
  context.moveTo(left, y(-0.5));
  context.lineTo(left + width, y(size - 0.5));
  context.stroke();
}

connect();
