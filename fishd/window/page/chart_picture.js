// A picture of all charts that are shown, with their titles, the fish and the time.
import { palette } from "./chart.js";
import { number, timeOfDay } from "./common.js";

const HEAD_PX = 58, MARGIN_PX = 14;

/** Return the picture as a canvas. */
export function drawPicture(charts, fish) {
  charts.draw(Infinity, true);
  const { ring, view, parent, cursor } = charts, frame = parent.getBoundingClientRect();
  const width = frame.width + 2 * MARGIN_PX, height = HEAD_PX + frame.height + MARGIN_PX;
  const canvas = Object.assign(document.createElement("canvas"), { width: width * devicePixelRatio, height: height * devicePixelRatio });
  const context = canvas.getContext("2d");
  context.scale(devicePixelRatio, devicePixelRatio);
  context.fillStyle = palette.surface;
  context.fillRect(0, 0, width, height);
  const write = (text, x, y, font, colour, textAlign = "left") => {
    Object.assign(context, { font: `${font} system-ui, sans-serif`, fillStyle: colour, textAlign });
    context.fillText(text, x, y, frame.width);
    return x + context.measureText(text).width + 12;
  };
  const [from, to] = view.span(ring.latest.time).map((time) => timeOfDay(ring.unixTime(time)));
  const day = new Date(ring.unixTime(view.span(ring.latest.time)[1]) * 1000).toLocaleDateString("sv");
  const values = cursor === null ? "" : `; values at ${timeOfDay(charts.cursorTick.t)}`;
  write(fish, MARGIN_PX, 28, "600 16px", palette.text);
  write(`${day}, ${from} to ${to} (${number(view.seconds, 1)} s)${values}`, MARGIN_PX, 48, "12px", palette.muted);
  for (const { root, plot, keys, readout, text } of charts.shown) {
    const place = (node) => {
      const box = node.getBoundingClientRect();
      return [box.left - frame.left + MARGIN_PX, box.top - frame.top + HEAD_PX, box.width, box.height];
    };
    const [left, top, wide] = place(root);
    let x = write(text, left + 2, top + 14, "600 13px", palette.text);
    for (const key of keys.children) {
      if (!key.hidden) x = write(key.textContent, x, top + 14, "12px", getComputedStyle(key, "::before").backgroundColor);
    }
    write(readout.value, left + wide, top + 14, "600 13px", palette.text, "right");
    context.drawImage(plot.ctx.canvas, ...place(plot.ctx.canvas));
  }
  return canvas;
}

/** Let the browser keep the picture as a file. */
export function savePicture(charts, fish) {
  drawPicture(charts, fish).toBlob((blob) => {
    const href = URL.createObjectURL(blob), time = new Date().toISOString().slice(0, 19).replaceAll(":", "");
    Object.assign(document.createElement("a"), { href, download: `${fish}-${time}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(href), 1000);
  });
}
