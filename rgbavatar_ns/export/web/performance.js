"use strict";
/* The recorded performance: theta of frame after frame. */

class RecordedPerformance {
  /** theta: the frames after one another; show: called with the theta of each new place. */
  constructor(theta, size, framesPerSecond, show) {
    this.length = theta.length / size;
    this.framesPerSecond = framesPerSecond;
    this.speed = 1;
    this._theta = theta;
    this._size = size;
    this._show = show;
    this._place = 0;
    this._playing = false;
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
    this._show(this._current());
  }

  pause() {
    this._playing = false;
  }

  /** Show the performance at a place in frames; beyond its ends, the nearest. */
  seek(place) {
    if (this.length === 0) return;
    this._place = Math.min(Math.max(place, 0), this.length - 1);
    this._show(this._current());
  }

  /** Go on by so many seconds where it plays; after the last frame comes the first. */
  advance(seconds) {
    if (!this._playing) return;
    this._place = (this._place + seconds * this.framesPerSecond * this.speed) % this.length;
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
