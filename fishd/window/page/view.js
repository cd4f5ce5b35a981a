// The span of time that all charts show: it follows the newest tick, or stands still.
import { KEPT_S } from "./ring.js";

const MIN_S = 0.5;
/** Distances between the labels of the time, of which a few fit [s]. */
const STEPS = [0.1, 0.2, 0.5, 1, 2, 3, 5, 10, 20, 60, 120, 300];

export class View {
  /** seconds: length of the span; high: its end, null while it follows the newest tick */
  constructor(seconds) {
    Object.assign(this, { seconds, high: null });
  }

  get isLive() {
    return this.high === null;
  }

  /** Return begin and end of the span; newest: time of the newest tick. */
  span(newest) {
    const high = this.high ?? newest;
    return [high - this.seconds, high];
  }

  /** Stand still, or follow again. */
  toggle(newest) {
    this.high = this.isLive ? newest : null;
  }

  /** Move by a fraction of the span, to later times if it is positive. */
  pan(fraction, newest) {
    this.#end((this.high ?? newest) + fraction * this.seconds, newest);
  }

  /** Make the span longer by a factor; the time at a fraction of it stays where it is, or the newest tick. */
  zoom(factor, fraction, newest) {
    const before = this.seconds;
    this.seconds = Math.min(KEPT_S, Math.max(MIN_S, before * factor));
    if (!this.isLive) this.#end(this.high + (1 - fraction) * (this.seconds - before), newest);
  }

  /** Return how long before the end of the span its labels are, and their distance [s]. */
  labels(most) {
    const step = STEPS.find((candidate) => this.seconds / candidate <= most);
    return [Array.from({ length: Math.floor(this.seconds / step + 1e-6) + 1 }, (_, index) => index * step).reverse(), step];
  }

  #end(high, newest) {
    this.high = Math.min(newest, Math.max(high, newest - KEPT_S + this.seconds));
  }
}
