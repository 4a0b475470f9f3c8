"use strict";
/* The recorded performance: theta of frame after frame. */

class RecordedPerformance {
  /** show: called with the theta of each new place. */
  constructor(data, show) {
    const { arrays, manifest } = data;
    this.length = manifest.arrays.theta.items;
    this.framesPerSecond = manifest.frames_per_second;
    this.speed = 1;
    this._data = data;
    this._part = manifest.parts.findIndex(({ slices }) => slices.some(([name]) => name === "theta"));
    this._theta = arrays.theta;
    this._size = manifest.arrays.theta.columns;
    this._show = show;
    this._place = 0;
    this._playing = false;
    this._awaited = false; // whether the place is to be shown as soon as the film has arrived
  }

  get playing() {
    return this._playing;
  }

  /** In frames, with a fraction. */
  get place() {
    return this._place;
  }

  /** Go on from the current place; nothing where there is no performance. */
  play() {
    if (this.length === 0) return;
    this._playing = true;
    this._awaited = false;
    if (this._isThere()) this._follow();
  }

  pause() {
    this._playing = false;
  }

  /** Pause, and show no place that is still awaited: something else is shown. */
  leave() {
    this.pause();
    this._awaited = false;
  }

  /** Show the performance at a place in frames; beyond its ends, the nearest. */
  seek(place) {
    if (this.length === 0) return;
    this._place = Math.min(Math.max(place, 0), this.length - 1);
    this._awaited = !this._isThere();
    if (!this._awaited) this._follow();
  }

  /** A part of the file has arrived. */
  arrived() {
    if (this._awaited && this._isThere()) this.seek(this._place);
  }

  /** Go on by so many seconds where it plays; after the last frame comes the first. */
  advance(seconds) {
    if (!this._playing || !this._isThere()) return;
    this._place = (this._place + seconds * this.framesPerSecond * this.speed) % this.length;
    this._follow();
  }

  /** Of a file that is still arriving, the film comes after the first picture. */
  _isThere() {
    return this._data.spans.length > this._part;
  }

  _follow() {
    this._show(this._current());
  }

  /** theta at the current place, linear between frames. */
  _current() {
    const first = Math.min(Math.floor(this._place), this.length - 1);
    const second = Math.min(first + 1, this.length - 1);
    const share = this._place - first, size = this._size;
    return Array.from({ length: size }, (_, i) => {
      const a = this._theta[first * size + i], b = this._theta[second * size + i];
      return share > 0 ? a + share * (b - a) : a;
    });
  }
}
