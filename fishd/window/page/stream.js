// The live stream: a WebSocket that is opened again when it is lost.
const RETRY_MS = 1000;
const HEARTBEAT_MS = 2000;
/** Time without a message after which a connection is taken for dead; the server sends one each second. */
const SILENCE_MS = 5000;

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
