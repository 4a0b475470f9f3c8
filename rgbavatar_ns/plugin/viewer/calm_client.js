// Frames of the page are drawn as they come while something happens, else four times a second.
{
  const IDLE_MS = 250, AFTER_INPUT_MS = 1000, AFTER_MESSAGE_MS = 300;
  const request = window.requestAnimationFrame.bind(window);
  const cancel = window.cancelAnimationFrame.bind(window);
  const waiting = new Map(), passedOn = new Map();
  let next = -1, timer = null, busyUntil = performance.now() + 10000;
  const passOn = () => {
    clearTimeout(timer);
    timer = null;
    for (const [number, callback] of waiting)
      passedOn.set(number, request((now) => { passedOn.delete(number); callback(now); }));
    waiting.clear();
  };
  const happens = (forMs) => {
    busyUntil = Math.max(busyUntil, performance.now() + forMs);
    passOn();
  };
  window.requestAnimationFrame = (callback) => {
    if (performance.now() < busyUntil) return request(callback);
    waiting.set(next, callback);
    timer ??= setTimeout(passOn, IDLE_MS);
    return next--;
  };
  window.cancelAnimationFrame = (number) => {
    waiting.delete(number);
    cancel(passedOn.get(number) ?? number);
  };
  for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "keydown", "resize"])
    window.addEventListener(kind, () => happens(AFTER_INPUT_MS), { capture: true, passive: true });
  const PlainWorker = window.Worker;
  window.Worker = class extends PlainWorker {
    constructor(...all) {
      super(...all);
      this.addEventListener("message", () => happens(AFTER_MESSAGE_MS));
    }
  };
}
