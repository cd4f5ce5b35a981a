// The fish from above: its tail follows the command and, if it is simulated, the true wheel and fin.
const HALF_LENGTH = 100;

/** Draw the latest tick into a canvas; angles are as measured, nothing is smoothed. */
export class TopView {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => this.draw(this.tick)).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw(this.tick));
  }

  draw(tick) {
    this.tick = tick;
    const { canvas, context } = this;
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = Math.round(canvas.clientHeight * devicePixelRatio);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`);
    const scale = Math.min(width / 260, height / 130);
    context.setTransform(scale, 0, 0, -scale, 0.47 * width, 0.5 * height); // y to the left of the fish
    context.clearRect(-500, -500, 1000, 1000);
    context.lineCap = context.lineJoin = "round";

    context.strokeStyle = colour("line");
    context.lineWidth = 1;
    context.setLineDash([3, 4]);
    this.#path([[-HALF_LENGTH - 16, 0], [HALF_LENGTH + 24, 0]]);
    context.setLineDash([]);

    const command = tick?.phi_c ?? 0;
    const wheel = tick?.phi ?? command;
    const fin = tick?.alpha;
    this.#tail(fin ?? wheel, wheel, colour("body"), colour("outline"));
    this.#body(colour("body"), colour("outline"));
    if (!tick?.servo_on) return; // no command is known, or none reaches the servo
    context.strokeStyle = colour("phi");
    context.lineWidth = 2.5;
    this.#path([[0, 0], [62 * Math.cos(command), 62 * Math.sin(command)]]);
    context.fillStyle = colour("phi");
    context.beginPath();
    context.arc(0, 0, 4, 0, 2 * Math.PI);
    context.fill();
  }

  #body(fill, stroke) {
    const { context } = this;
    this.#fill(fill, stroke, () => {
      for (const side of [-1, 1]) { // pectoral fins
        context.moveTo(-62, 20 * side);
        context.quadraticCurveTo(-50, 46 * side, -28, 42 * side);
        context.quadraticCurveTo(-36, 30 * side, -36, 20 * side);
      }
    });
    this.#fill(fill, stroke, () => {
      context.moveTo(-HALF_LENGTH, 0);
      context.bezierCurveTo(-HALF_LENGTH, -27, -58, -30, 6, -11);
      context.quadraticCurveTo(13, 0, 6, 11);
      context.bezierCurveTo(-58, 30, -HALF_LENGTH, 27, -HALF_LENGTH, 0);
    });
    context.fillStyle = stroke;
    for (const side of [-1, 1]) {
      context.beginPath();
      context.arc(-83, 10 * side, 2.4, 0, 2 * Math.PI);
      context.fill();
    }
  }

  /** Draw a tail that leaves the hinge along the wheel and ends along the fin. */
  #tail(fin, wheel, fill, stroke) {
    const { context } = this;
    const bend = [44 * Math.cos(wheel), 44 * Math.sin(wheel)];
    const along = [Math.cos(fin), Math.sin(fin)], across = [-along[1], along[0]];
    const at = (distance, side) => [0, 1].map((i) => bend[i] + distance * along[i] + side * across[i]);
    this.#fill(fill, stroke, () => {
      context.moveTo(0, -10);
      context.quadraticCurveTo(...bend, ...at(34, -3.5));
      context.quadraticCurveTo(...at(46, -2), ...at(62, 0));
      context.quadraticCurveTo(...at(46, 2), ...at(34, 3.5));
      context.quadraticCurveTo(...bend, 0, 10);
      context.closePath();
    });
  }

  #fill(fill, stroke, trace) {
    const { context } = this;
    context.beginPath();
    trace();
    Object.assign(context, { fillStyle: fill, strokeStyle: stroke, lineWidth: 1.5 });
    context.fill();
    context.stroke();
  }

  #path(points) {
    this.context.beginPath();
    points.forEach(([x, y], index) => (index ? this.context.lineTo(x, y) : this.context.moveTo(x, y)));
    this.context.stroke();
  }
}
