"use strict";
/* The controls: performance, named expressions, jaw, eyes, head, learned bases, background. */

class Panel {
  /** app: see main.js. Every control writes to the app, and `show` reads it back. */
  constructor(root, app) {
    this.root = root;
    this.app = app;
    this.readers = [];
    this.watched = []; // [name, places in theta] of sliders, to tell what is beyond the film
    if (app.performance.length > 0) this._performance();
    for (const [title, open, entries] of this._thetaGroups()) this._theta(title, open, entries);
    if (app.data.num_bases > 0) this._bases();
    this._picture();
  }

  /** Bring all controls to the app's state. */
  show() {
    for (const read of this.readers) read();
  }

  /** Names of the sliders that stand where the film never was. */
  namesBeyond() {
    const beyond = ([, places]) => places.some((place) => this.app.isBeyond(place));
    const names = this.watched.filter(beyond).map(([name]) => name);
    return names.length > 4 ? [...names.slice(0, 4), `${names.length - 4} more`] : names;
  }

  _group(title, open) {
    const group = document.createElement("details");
    group.open = open;
    const summary = document.createElement("summary");
    summary.textContent = title;
    group.append(summary);
    this.root.append(group);
    return group;
  }

  _button(group, text, act) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.addEventListener("click", () => { act(); this.app.changed(); });
    group.append(button);
    return button;
  }

  /** A labelled slider; `read` gives the app's value, `write` sets it. */
  _slider(group, name, [low, high], read, write, step = (high - low) / 400) {
    const row = document.createElement("div");
    row.className = "row";
    const label = document.createElement("label");
    const input = document.createElement("input");
    const output = document.createElement("output");
    const id = `slider-${name.replace(/\W+/g, "-")}`;
    Object.assign(input, { type: "range", min: low, max: high, step, id });
    label.htmlFor = output.htmlFor = id;
    label.textContent = label.title = name;
    input.addEventListener("input", () => { write(Number(input.value)); this.app.changed(); });
    this.readers.push(() => {
      const value = read();
      if (document.activeElement !== input || Number(input.value) !== value) input.value = value;
      output.textContent = value.toFixed(step >= 1 ? 0 : 2);
    });
    row.append(label, input, output);
    group.append(row);
    return row;
  }

  _performance() {
    const { performance, app } = { performance: this.app.performance, app: this.app };
    const group = this._group("Performance", true);
    const play = this._button(group, "Play", () => app.play(!performance.playing));
    play.id = "play";
    this.readers.push(() => { play.textContent = performance.playing ? "Pause" : "Play"; });
    this._slider(group, "Frame", [0, performance.length - 1],
      () => Math.floor(performance.place), (value) => app.showFrame(value), 1);
    this._slider(group, "Speed", [0.1, 2], () => performance.speed,
      (value) => { performance.speed = value; });
  }

  /** Sliders by group: [title, open, [name, place in theta, range, places moved along]]. */
  _thetaGroups() {
    const { layout, expression_names: names, expression_range: range, expression_order: order }
      = this.app.data;
    const start = {};
    layout.reduce((sum, { name, size }) => { start[name] = sum; return sum + size; }, 0);
    const turns = (field, reach) => ["nod", "turn", "tilt"].map(
      (name, axis) => [`${field} ${name}`, [start[field] + axis], [-reach, reach]]);
    const face = [["jaw open", [start.jaw], [0, 0.5]], ["jaw sideways", [start.jaw + 1], [-0.2, 0.2]]];
    for (const [name, axis] of [["eyes down", 0], ["eyes sideways", 1]]) {
      face.push([name, [start.left_eye + axis, start.right_eye + axis], [-0.5, 0.5]]);
    }
    if ("eyelids" in start) {
      face.push(["left eyelid", [start.eyelids], [0, 1]], ["right eyelid", [start.eyelids + 1], [0, 1]]);
    }
    return [
      ["Jaw and eyes", true, face],
      ["Head", true, [...turns("neck", 0.8), ...turns("rotation", 0.8)]],
      ["Expressions", true, order.map(
        (i) => [names[i], [start.expression + i], [range[0][i], range[1][i]]])],
    ];
  }

  _theta(title, open, entries) {
    const app = this.app, group = this._group(title, open);
    this._button(group, "Reset", () => {
      for (const [, places] of entries) for (const place of places) app.setParameter(place, 0);
    });
    const [low, high] = app.data.film.theta ?? [];
    for (const [name, places, range] of entries) {
      const row = this._slider(group, name, range, () => app.theta[places[0]], (value) => {
        for (const place of places) app.setParameter(place, value);
      });
      if (!low) continue;
      const [from, to] = [Math.max(low[places[0]], range[0]), Math.min(high[places[0]], range[1])];
      row.title = `in the film ${from.toFixed(2)} to ${to.toFixed(2)}`;
      const input = row.querySelector("input"), ends = document.createElement("datalist");
      ends.id = `${input.id}-film`; // the browser marks its values on the slider
      const onStep = (value) => range[0] + Math.round((value - range[0]) / input.step) * input.step;
      ends.append(new Option("", onStep(from)), new Option("", onStep(to)));
      input.setAttribute("list", ends.id);
      row.append(ends);
      if (title !== "Head") this.watched.push([name, places]);
      this.readers.push(() => row.classList.toggle("beyond", places.some((p) => app.isBeyond(p))));
    }
  }

  _bases() {
    const app = this.app, group = this._group("Learned bases", false);
    this._button(group, "Back to the network", () => app.releaseWeights());
    app.data.psi_range.forEach((reach, k) => {
      const row = this._slider(group, `psi ${k}`, [-reach, reach],
        () => app.psi[k] ?? 0, (value) => app.setWeight(k, value));
      this.readers.push(() => row.classList.toggle("held", app.heldWeights.has(k)));
    });
  }

  _picture() {
    const app = this.app, group = this._group("Picture", false);
    const input = document.createElement("input");
    input.type = "color";
    input.id = "background";
    const byte = (value) => Math.round(255 * value).toString(16).padStart(2, "0");
    input.value = `#${app.background.map(byte).join("")}`;
    input.addEventListener("input", () => {
      app.background = [1, 3, 5].map((i) => parseInt(input.value.slice(i, i + 2), 16) / 255);
      app.changed();
    });
    const label = document.createElement("label");
    label.textContent = "Background ";
    label.append(input);
    group.append(label, document.createElement("br"));
    const free = document.createElement("input");
    Object.assign(free, { type: "checkbox", id: "turn-freely" });
    free.addEventListener("input", () => { app.orbit.free = free.checked; app.changed(); });
    const freely = document.createElement("label");
    freely.append(free, " Turn freely, beyond what was filmed");
    group.append(freely, document.createElement("br"));
    this._button(group, "Camera back", () => app.orbit.reset());
    this._button(group, "Save picture", () => app.savePicture());
  }
}
