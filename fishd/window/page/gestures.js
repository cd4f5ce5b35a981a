// Movements of pointers and wheel, and keys over a chart, as changes of the view.
const TAP_PX = 6;
export const ZOOM = 1.5;
const PAN = 0.2, WHEEL_ZOOM = 0.0025;

const middle = (points) => points.reduce((sum, { x }) => sum + x, 0) / points.length;
/** Return the distance of two fingers, in whatever direction; 0 for one. */
const spread = ([a, b]) => (b ? Math.hypot(a.x - b.x, a.y - b.y) : 0);

/**
 * Follow the pointers over an element: drag to pan, two fingers or Ctrl with the wheel to zoom, and taps.
 * pan(fraction), zoom(factor, fraction), tap(fraction): get fractions of its width
 */
export function followPointers(node, { pan, zoom, tap }) {
  const pointers = new Map();
  let travelled = 0, start = null;
  const fractionAt = (x) => Math.min(1, Math.max(0, (x - node.getBoundingClientRect().left) / node.clientWidth));
  node.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    if (pointers.size === 0) [travelled, start] = [0, event];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    node.setPointerCapture(event.pointerId);
  });
  node.addEventListener("pointermove", ({ pointerId, clientX: x, clientY: y, pointerType }) => {
    if (!pointers.has(pointerId)) return;
    const before = [...pointers.values()], { x: from, y: above } = pointers.get(pointerId);
    travelled += Math.hypot(x - from, y - above);
    const after = [...pointers.set(pointerId, { x, y }).values()];
    // A finger that goes up or down scrolls the page, which the browser begins a little later.
    const scrolls = pointerType === "touch" && after.length === 1 && Math.abs(y - start.clientY) > Math.abs(x - start.clientX);
    if (travelled <= TAP_PX || scrolls) return;
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
