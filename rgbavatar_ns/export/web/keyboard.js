"use strict";
/* The keys of the page, and what its help says of them. */

const TURN_BY_KEY = Math.PI / 36; // 5 degrees
const ZOOM_BY_KEY = 1.1;

const HELP = [
  ["drag, one finger, arrows", "turn"],
  ["wheel, two fingers, + and -", "zoom"],
  ["Shift or right button, two fingers", "move"],
  ["space", "play and pause"],
  ["r, double click", "back to the start; r also brings the calm face"],
  ["f", "hide and show the controls"],
  ["c", "driven live: whoever performs looks calm, mouth closed"],
];

/** What a key does, by the name that the browser gives it. */
function keyActions(app) {
  const { camera } = app.avatar;
  const actions = {
    " ": () => app.play(!app.avatar.performance.playing),
    ArrowLeft: () => camera.pull(-TURN_BY_KEY, 0),
    ArrowRight: () => camera.pull(TURN_BY_KEY, 0),
    ArrowUp: () => camera.pull(0, -TURN_BY_KEY),
    ArrowDown: () => camera.pull(0, TURN_BY_KEY),
    "+": () => camera.zoom(ZOOM_BY_KEY),
    "-": () => camera.zoom(1 / ZOOM_BY_KEY),
    r: () => app.reset(),
    f: () => app.fold(),
    c: () => app.connection?.calibrate(),
  };
  actions["="] = actions["+"]; // the same key without Shift
  return actions;
}

/** What has a meaning of its own for a key. */
function ownersOf(key) {
  if (key === " ") return "input:not([type=range]), button, summary";
  return key.length === 1 ? "input:not([type=range], [type=checkbox])" : "input";
}

/** Keys act wherever they have no meaning of their own: arrows on sliders have, space on buttons. */
function listenToKeys(app) {
  const actions = keyActions(app);
  document.addEventListener("keydown", (event) => {
    const act = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const own = event.target.closest?.(ownersOf(event.key));
    if (!act || own || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    app.avatar.changed();
  });
}
