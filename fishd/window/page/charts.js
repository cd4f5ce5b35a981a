// All charts of a fish over one common time, with one cursor.
import { Chart, readPalette } from "./chart.js";
import { Arrangement, CHARTS, namedChart, namedColumns } from "./chart_list.js";
import { forceUnit, number, recall, remember, timeOfDay } from "./common.js";
import { pressKey } from "./gestures.js";
import { View } from "./view.js";

/** Number of charts for the quantities of a controller and the readings of sensors. */
const NAMED_CHARTS = 20;
/** Shortest and longest time between two drawings, and the time with reduced motion [ms]. */
const FRAME_MS = 50, SLOW_FRAME_MS = 250, REDUCED_FRAME_MS = 1000;
const MAX_MARKS = 64;
/** A mark at a tick of the past: its text ends with the tick. */
const MARK_AT = /^(.*?) \(tick (\d+)\)$/s;

export class Charts {
  /**
   * parent: element of the charts
   * changed: called when view, cursor or charts have changed; say: says a text to screen readers
   */
  constructor(parent, { changed, say }) {
    Object.assign(this, { parent, changed, say, length: 2, marks: [], gaps: [], limits: null, virtual: null });
    Object.assign(this, { all: [], namedCharts: [], names: "", cursor: null, first: null, drawn: 0, dirty: true });
    readPalette();
    this.view = new View(recall("seconds", 15));
    this.arrangement = new Arrangement();
    this.times = this.newColumn();
    this.motion = matchMedia("(prefers-reduced-motion: reduce)");
    const { view } = this;
    this.actions = {
      pause: () => this.#move((newest) => view.toggle(newest)),
      follow: () => this.#move((newest) => view.isLive || view.toggle(newest)),
      pan: (fraction) => this.#move((newest) => view.pan(fraction, newest)),
      zoom: (factor, fraction = 0.5) => this.#move((newest) => view.zoom(factor, fraction, newest)),
      tap: (fraction) => this.#move((newest) => (this.cursor = view.span(newest)[0] + fraction * view.seconds)),
      clear: () => this.setCursor(null),
    };
    this.watch = new IntersectionObserver((entries) => {
      for (const entry of entries) this.all.find(({ root }) => root === entry.target).visible = entry.isIntersecting;
      this.#changed();
    });
    this.charts = CHARTS.map((definition) => this.#add(definition));
    this.arrange();
    new ResizeObserver(() => this.all.forEach((chart) => chart.size())).observe(parent);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      readPalette();
      this.dirty = true;
    });
  }

  newColumn() {
    return new Array(this.length).fill(null);
  }

  /** Use another ring, after a connection or a restart. */
  setRing(ring) {
    Object.assign(this, { ring, cursor: null });
    this.#changed();
  }

  setSeconds(seconds) {
    remember("seconds", seconds);
    this.view.zoom(seconds / this.view.seconds, 1, this.ring.latest?.time);
    this.#changed();
  }

  /** Note that ticks have come; a view that stands still does not change, unless they are of a new fishd. */
  advance() {
    if (this.view.high - this.view.seconds > this.ring.latest.time) this.actions.follow();
    this.dirty ||= this.view.isLive;
  }

  /** Fit units, limits, quantities of the controller and readings of sensors to the status. */
  setStatus(status, controller) {
    const [factor, unit] = forceUnit(status);
    for (const chart of this.charts) if (chart.definition.force) chart.setUnit(unit, factor);
    this.limits = status ? [status.lowest_angle, status.highest_angle] : null;
    const named = namedColumns(status, controller).slice(0, NAMED_CHARTS), names = named.map(({ column }) => column).join();
    if (names === this.names) return;
    this.names = names;
    while (this.namedCharts.length < named.length) this.namedCharts.push(this.#add(namedChart()));
    this.namedCharts.forEach((chart, index) => {
      chart.known = false;
      chart.setColumn(named[index] ?? { title: [""] });
    });
    this.arrange();
  }

  /** Charts that have values, in the order of this browser. */
  get available() {
    return this.arrangement.sort(this.all.filter(({ known }) => known));
  }

  /** Charts that are shown, in their order. */
  get shown() {
    return this.available.filter(({ root }) => !root.hidden);
  }

  /** Change the arrangement, and show the chosen charts in their order. */
  arrange(change = () => {}) {
    change();
    for (const chart of this.all) chart.root.hidden = !chart.known || this.arrangement.hidden.includes(chart.key);
    let before = null;
    for (const { root } of this.available) {
      if (root.previousElementSibling !== before) this.parent.insertBefore(root, before ? before.nextSibling : this.parent.firstChild);
      before = root;
    }
    [this.first = null] = this.shown;
    this.filled = "";
    for (const chart of this.shown) chart.size();
    this.#changed();
  }

  /** Note a change, or a mark at a tick of the past. */
  mark(time, text) {
    const [, words, seq] = MARK_AT.exec(text) ?? [];
    this.marks.push(seq ? { time: NaN, text: words, seq: Number(seq) } : { time, text, seq: null });
    if (this.marks.length > MAX_MARKS) this.marks.shift();
    this.dirty = true;
  }

  /** Show the values at a time in all charts; null: the latest ones. */
  setCursor(time) {
    this.cursor = time;
    this.#changed();
  }

  /** Return unix time and number of the tick at the cursor, and its age [s]. */
  get cursorTick() {
    const { ring, cursor } = this;
    return { t: ring.unixTime(cursor), seq: ring.seqAt(cursor), age: ring.latest.time - cursor };
  }

  /** Show the time at the pointer or the cursor; null: the end of a view that stands still. */
  showTime(time) {
    const at = time ?? this.view.high, { ring } = this, output = document.getElementById("chart-time");
    const text = at === null || !ring.latest ? "" : `${timeOfDay(ring.unixTime(at))}, ${number(ring.latest.time - at, 2)} s ago`;
    if (output && output.textContent !== text) output.textContent = text;
  }

  /** Carry out a key over a chart. */
  press(event, chart) {
    const step = (by) => {
      const { ring } = this, [low, high] = this.view.span(ring.latest?.time), level = ring.level(low, high);
      this.setCursor(Math.min(ring.latest.time, Math.max(level.oldest, (this.cursor ?? high) + by * level.period)));
      this.draw(Infinity);
      this.say(`${chart.text}: ${chart.readout.value}, ${number(this.cursorTick.age, 2)} s ago`);
    };
    if (this.ring.rows) pressKey(event, { ...this.actions, step });
  }

  /** Return how long the next drawing has to wait [ms]: a view of minutes moves slowly. */
  waitMs(now) {
    const pixelMs = (1000 * this.view.seconds) / (this.first?.plot.width ?? 300);
    const pause = this.motion.matches ? REDUCED_FRAME_MS : Math.min(SLOW_FRAME_MS, Math.max(FRAME_MS, pixelMs));
    return this.view.isLive ? Math.max(0, this.drawn + pause - 4 - now) : 0;
  }

  /** Draw what is in sight, or all charts, if anything is new and the last drawing is old enough. */
  draw(now, isAll = false) {
    const { ring, view } = this;
    if (!ring?.rows || !(isAll || (this.dirty && this.waitMs(now) === 0))) return;
    this.drawn = Math.min(now, performance.now());
    this.dirty = false;
    const isNew = ({ definition, known }) => !known && ring.has(definition.series[0].column);
    if (this.all.some(isNew)) this.arrange(() => this.all.filter(isNew).forEach((chart) => (chart.known = true)));
    const charts = this.shown.filter((chart) => isAll || !view.isLive || chart.visible || !chart.drawn);
    if (!charts.length) return;
    const [low, high] = view.span(ring.latest.time), filled = `${low} ${high}`;
    const level = ring.level(low, high), skip = Math.max(0, level.newer(high) - 1);
    if (filled !== this.filled) this.#take(level, skip);
    for (const mark of this.marks) {
      if (Number.isNaN(mark.time)) mark.time = ring.timeOf(mark.seq);
      else if (mark.seq === null && mark.time >= low) mark.seq = ring.seqAt(mark.time);
    }
    for (const chart of charts) {
      chart.drawn = true;
      if (filled !== this.filled) chart.fill(level, skip);
      chart.draw(low, high);
    }
    this.filled = view.isLive ? "" : filled;
  }

  /** Draw the thrust of a simulated fish, which may be null, in the chart of the thrust [N]. */
  setVirtual(thrust) {
    this.dirty ||= thrust !== this.virtual;
    this.virtual = thrust;
  }

  #add(definition) {
    const chart = new Chart(this.parent, definition, this);
    this.all.push(chart);
    this.watch.observe(chart.root);
    return chart;
  }

  #move(change) {
    if (!this.ring.rows) return;
    change(this.ring.latest.time);
    this.#changed();
  }

  #changed() {
    this.dirty = true;
    this.changed();
  }

  /** Take times and gaps of the view from the ticks or the bins. */
  #take(level, skip) {
    this.length = Math.min(level.capacity, Math.ceil(this.view.seconds / level.period) + 64);
    if (this.length !== this.times.length) [this.times, this.numbers] = [this.newColumn(), this.newColumn()];
    const { times, numbers, length } = this;
    level.copyTimes(times, skip);
    level.copy("seq", numbers, 1, skip);
    this.gaps = numbers.flatMap((seq, i) => (seq === null && i > length - level.rows + skip && i > 0 && i < length - 1 ? [[times[i - 1], times[i + 1]]] : []));
  }
}
