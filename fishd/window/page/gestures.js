// Movements of pointers and wheel, and keys over a chart, as changes of the view.
const TAP_PX = 6;
export const ZOOM = 1.5;
const PAN = 0.2, WHEEL_ZOOM = 0.0025;

const middle = (xs) => (Math.min(...xs) + Math.max(...xs)) / 2;
const spread = (xs) => Math.max(...xs) - Math.min(...xs);

/**
 * Follow the pointers over an element: drag to pan, two fingers or Ctrl with the wheel to zoom, and taps.
 * pan(fraction), zoom(factor, fraction), tap(fraction): get fractions of its width
 */
export function followPointers(node, { pan, zoom, tap }) {
  const pointers = new Map();
  let travelled = 0;
  const fractionAt = (x) => Math.min(1, Math.max(0, (x - node.getBoundingClientRect().left) / node.clientWidth));
  node.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    if (pointers.size === 0) travelled = 0;
    pointers.set(event.pointerId, event.clientX);
    node.setPointerCapture(event.pointerId);
  });
  node.addEventListener("pointermove", ({ pointerId, clientX }) => {
    if (!pointers.has(pointerId)) return;
    const before = [...pointers.values()];
    travelled += Math.abs(clientX - pointers.get(pointerId));
    const after = [...pointers.set(pointerId, clientX).values()];
    if (travelled <= TAP_PX) return;
    if (spread(before) > 0 && spread(after) > 0) zoom(spread(before) / spread(after), fractionAt(middle(after)));
    pan((middle(before) - middle(after)) / node.clientWidth);
  });
  const end = ({ type, pointerId, clientX }) => {
    const isTap = type === "pointerup" && travelled <= TAP_PX && pointers.size === 1;
    if (pointers.delete(pointerId) && isTap) tap(fractionAt(clientX));
  };
  for (const kind of ["pointerup", "pointercancel"]) node.addEventListener(kind, end);
  node.addEventListener("wheel", (event) => {
    if (event.ctrlKey) zoom(Math.exp(WHEEL_ZOOM * event.deltaY), fractionAt(event.clientX));
    else if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) pan(event.deltaX / node.clientWidth);
    else return;
    event.preventDefault();
  }, { passive: false });
}

/** What the keys do while a chart has the focus, for screen readers, too. */
export const KEYS_HELP = "Space pauses or follows. Left and right arrow: earlier or later. Plus and minus: zoom. "
  + "With Shift, the arrows move the cursor from tick to tick; Escape removes it. End: the latest tick.";

/** Carry out a key over a chart. */
export function pressKey(event, { pause, pan, zoom, step, follow, clear }) {
  const sideways = (by) => () => (event.shiftKey ? step(by) : pan(by * PAN));
  const action = {
    " ": pause, End: follow, Escape: clear, ArrowLeft: sideways(-1), ArrowRight: sideways(1),
    "+": () => zoom(1 / ZOOM), "=": () => zoom(1 / ZOOM), "-": () => zoom(ZOOM),
  }[event.key];
  if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  action();
}
