// The live stream: a WebSocket that is opened again when it is lost, and the ring that keeps its ticks.
const RETRY_MS = 1000;
const HEARTBEAT_MS = 2000;
/** Time without a message after which a connection is taken for dead; the server sends one each second. */
const SILENCE_MS = 5000;
const KEPT_S = 120;
const MAX_ROWS = 24_000;
const MAX_COLUMNS = 64;
const CLOCK_JUMP_S = 1;
/** Prefixes of the columns of a controller's quantity and of a sensor's reading. */
export const QUANTITY = "quantity:", READING = "reading:";

/** Columns of fixed length with the latest ticks; a row of NaN where ticks were lost. */
export class Ring {
  constructor(period) {
    this.period = period;
    this.capacity = Math.min(MAX_ROWS, Math.max(2400, Math.ceil(KEPT_S / period))) + 256;
    this.columns = new Map();
    this.clear();
    for (const name of ["time", "seq"]) this.#add(name);
  }

  clear() {
    this.rows = 0;
    this.next = 0;
    this.lost = 0;
    this.latest = null;
    for (const column of this.columns.values()) column.fill(NaN);
  }

  /** Add a tick; a gap before it becomes a row without values. */
  push(tick) {
    const before = this.latest;
    if (before) {
      if (tick.time < before.time - CLOCK_JUMP_S) this.clear();
      else if (tick.time <= before.time) return;
      else if (tick.seq !== before.seq + 1 || tick.time - before.time > Math.max(1, 4 * this.period)) {
        if (tick.seq > before.seq + 1) {
          this.lost += tick.seq - before.seq - 1;
          this.lostAt = tick.time;
        }
        this.#row();
        this.#write("time", 0.5 * (tick.time + before.time));
      }
    }
    if (this.lost && tick.time - this.lostAt > KEPT_S) this.lost = 0;
    this.#row();
    for (const name in tick) {
      if (typeof tick[name] === "number" && (name !== "phi_c" || tick.servo_on !== false)) this.#write(name, tick[name]);
    }
    for (const name in tick.quantities) this.#write(QUANTITY + name, tick.quantities[name]);
    for (const name in tick.readings) this.#write(READING + name, tick.readings[name]);
    if (tick.suspect) {
      this.#write("suspect_fx", tick.fx);
      this.#write("suspect_fy", tick.fy);
    }
    if (tick.thrust_ci95 != null) {
      this.#write("thrust_low", tick.thrust - tick.thrust_ci95);
      this.#write("thrust_high", tick.thrust + tick.thrust_ci95);
    }
    this.latest = tick;
  }

  /** Return the number of the first tick at or after a time; null if it is not in the ring. */
  seqAt(time) {
    const times = this.columns.get("time"), numbers = this.columns.get("seq");
    for (let age = this.rows; age >= 1; age--) {
      const row = (this.next - age + this.capacity) % this.capacity;
      if (times[row] >= time - 0.5 * this.period && !Number.isNaN(numbers[row])) return numbers[row];
    }
    return null;
  }

  /** Return whether a column has a value anywhere. */
  has(name) {
    return this.columns.get(name)?.some((value) => !Number.isNaN(value)) ?? false;
  }

  /** Copy the latest values of a column into an array of fixed length; null where there is none. */
  copy(name, target, factor = 1) {
    const column = this.columns.get(name), length = target.length;
    const filled = column ? Math.min(this.rows, length) : 0;
    target.fill(null, 0, length - filled);
    for (let i = length - filled, row = (this.next - filled + this.capacity) % this.capacity; i < length; i++) {
      const value = column[row];
      target[i] = Number.isNaN(value) ? null : value * factor;
      if (++row === this.capacity) row = 0;
    }
  }

  /** Copy the latest times; rows that are not filled yet continue the time backwards. */
  copyTimes(target) {
    this.copy("time", target);
    const first = target.length - Math.min(this.rows, target.length);
    for (let i = first - 1; i >= 0; i--) target[i] = (target[i + 1] ?? 0) - this.period;
  }

  #row() {
    this.at = this.next;
    for (const column of this.columns.values()) column[this.at] = NaN;
    this.next = (this.next + 1) % this.capacity;
    this.rows = Math.min(this.rows + 1, this.capacity);
  }

  #write(name, value) {
    const column = this.columns.get(name) ?? this.#add(name);
    if (column && value !== null) column[this.at] = value;
  }

  #add(name) {
    if (this.columns.size >= MAX_COLUMNS) return null;
    const column = new Float64Array(this.capacity).fill(NaN);
    this.columns.set(name, column);
    return column;
  }
}

/** Yield the ticks that columns hold. */
export function* ticksOf(history) {
  const { quantities = {}, readings = {}, ...columns } = history;
  for (let row = 0; row < columns.seq.length; row++) {
    const tick = {};
    for (const name in columns) if (columns[name][row] != null) tick[name] = columns[name][row];
    for (const [kind, named] of Object.entries({ quantities, readings })) {
      const own = Object.entries(named).filter(([, column]) => column[row] != null);
      if (own.length) tick[kind] = Object.fromEntries(own.map(([name, column]) => [name, column[row]]));
    }
    yield tick;
  }
}

/** The connection to the server for one fish. */
export class Stream {
  /**
   * client: identifier that the server gave to this page before, or empty
   * take: called with type and payload of each message; closed: after each end of the connection, before it is opened again
   */
  constructor(fish, client, take, closed) {
    Object.assign(this, { fish, client, take, closed });
    this.beaten = 0;
    this.#connect();
  }

  #connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const query = new URLSearchParams();
    if (this.fish) query.set("fish", this.fish);
    if (this.client) query.set("client", this.client); // goes on driving
    const socket = (this.socket = new WebSocket(`${scheme}://${location.host}/live?${query}`));
    let silence;
    const end = () => {
      clearTimeout(silence);
      socket.onmessage = socket.onclose = null;
      socket.close();
      this.closed();
      setTimeout(() => this.#connect(), RETRY_MS);
    };
    const listen = () => {
      clearTimeout(silence);
      silence = setTimeout(end, SILENCE_MS);
    };
    listen();
    socket.onmessage = (event) => {
      listen();
      this.#beat();
      this.take(...JSON.parse(event.data));
    };
    socket.onclose = end;
  }

  /** Give a sign of life; not from a timer, as browsers slow the timers of hidden tabs. */
  #beat() {
    const now = performance.now();
    if (now - this.beaten < HEARTBEAT_MS) return;
    this.beaten = now;
    this.socket.send(JSON.stringify(["seen", Date.now() / 1000]));
  }
}
