"use strict";
/* Driven from outside: "rgbavatar-drive", version 1, over a WebSocket or by postMessage. */

const DRIVE = { format: "rgbavatar-drive", version: 1 };
const RETRY_SECONDS = [1, 2, 4, 5]; // from loss to loss; the last one again and again
const LONGEST_MESSAGE = 1 << 17; // characters: hundreds of thetas
const LONGEST_STATUS = 200;
const GOING_IN_ORDER = 1000; // of who hangs up, and has said why

/** What reaches the avatar from outside, unless somebody at the page has taken over. */
class Driver {
  constructor(avatar) {
    this.avatar = avatar;
    this.active = true;
    this.driven = false; // by anything, so far
    this._shown = () => {};
    avatar.addEventListener("drawn", () => {
      const answer = this._shown;
      this._shown = () => {};
      answer();
    });
  }

  /** Show a message of type theta or arkit; `shown` is called after its picture was drawn. */
  show(message, shown) {
    if (!this.active) return;
    if (message.type === "theta") this.avatar.setTheta(message.theta);
    else this.avatar.setARKit(message.coefficients ?? {}, message.pose);
    this.driven = true;
    this._shown = shown; // the newest message's alone: no picture will be of an older one
  }
}

/** One sender's messages, after one another. */
class DriveChannel {
  /** answer: sends an object back; greeted: whether it may begin without a "hello". */
  constructor(driver, answer, greeted) {
    this._driver = driver;
    this._answer = answer;
    this._greeted = greeted;
    this._refused = false;
  }

  /** Whether the sender speaks of this head in this version. */
  get accepted() {
    return this._greeted && !this._refused;
  }

  /** Take a message; returns a status to be shown, or null. Throws an Error with a reason. */
  take(message) {
    if (typeof message !== "object" || message === null || Array.isArray(message)) {
      throw new Error("a message is no object");
    }
    if (message.type === "hello") return this._greet(message);
    if (this._refused) return null; // as was told
    if (!this._greeted) throw new Error(`its first message is no "hello" of ${DRIVE.format}`);
    if (message.type === "status") return this._status(message.text);
    if (message.type !== "theta" && message.type !== "arkit") {
      throw new Error(`there is no message of type ${inWords(message.type)}`);
    }
    const { index } = message;
    this._driver.show(message, () => {
      if (Number.isInteger(index)) this._answer({ type: "shown", index });
    });
    return null;
  }

  _greet({ format, version, layout }) {
    this._greeted = true;
    this._refused = true;
    if (format !== DRIVE.format || version !== DRIVE.version) {
      throw new Error(`it speaks another version, ${inWords(format)} ${inWords(version)}; `
        + `this page speaks ${DRIVE.format} ${DRIVE.version}`);
    }
    const { avatar } = this._driver;
    if (!new ThetaFields(avatar.layout).equals(layout)) {
      const size = Array.isArray(layout) ? layout.reduce((sum, field) => sum + field?.size, 0) : "?";
      throw new Error(`it drives another head (theta of ${size} numbers, this one takes `
        + `${avatar.neutralTheta.length})`);
    }
    this._refused = false;
    return null;
  }

  _status(text) {
    if (typeof text !== "string") throw new Error("a status is no text");
    return text.slice(0, LONGEST_STATUS);
  }
}

/** The address that the page was asked to be driven from; throws an Error unless it may be. */
function driveAddress(text, servers) {
  let url;
  try {
    url = new URL(text);
  } catch {
    throw new Error(`?ws=${text.slice(0, 60)} is no address; expected ws://127.0.0.1:PORT`);
  }
  const loopback = ["127.0.0.1", "localhost"].includes(url.hostname);
  if (!["ws:", "wss:"].includes(url.protocol) || url.hash
    || !(loopback || servers.includes(`${url.protocol}//${url.host}`))) {
    throw new Error(`this page is not driven from ${text.slice(0, 60)}; expected ws://127.0.0.1:PORT`
      + `${servers.map((server) => ` or ${server}`).join("")}`);
  }
  return url;
}

/** A WebSocket that comes back by itself. */
class LiveConnection {
  /** tell: called with a text for everything that happens, and whether it is a problem. */
  constructor(url, driver, tell) {
    this._url = url;
    this._driver = driver;
    this._tell = tell;
    this._losses = 0; // since somebody spoke our language
    this.connected = false; // to somebody who drives this head
    this._open();
  }

  /** Ask for the performer's face to be taken as the calm one. */
  calibrate() {
    this._send({ type: "calibrate" });
  }

  _send(message) {
    if (this._socket.readyState === WebSocket.OPEN) this._socket.send(JSON.stringify(message));
  }

  _open() {
    const { host } = this._url, socket = new WebSocket(this._url);
    const channel = new DriveChannel(this._driver, (message) => this._send(message), false);
    this._socket = socket;
    let status = "", unusable = 0, opened = false;
    this._tell(`connecting to ${host} ...`, false);
    socket.onopen = () => { opened = true; };
    socket.onmessage = ({ data }) => {
      try {
        status = channel.take(parsed(data)) ?? status;
        this.connected = channel.accepted;
        if (!this.connected) return;
        this._losses = 0;
        const left = unusable === 0 ? "" : `, ${unusable} messages could not be used`;
        this._tell(`connected to ${host}${left}${status && `: ${status}`}`, false);
      } catch (error) {
        unusable++;
        this.connected = channel.accepted;
        this._tell(`${host} cannot be used: ${error.message}`, true);
      }
    };
    socket.onclose = ({ code }) => {
      this.connected = false;
      const farewell = code === GOING_IN_ORDER && status.replace(/\.$/, "");
      this._wait(farewell || (opened ? "connection lost" : `no answer from ${host}${this._hint()}`));
    };
  }

  /** Servers of ours tell a page from the disk by the key in the address that they print. */
  _hint() {
    const keyless = window.origin === "null" && this._url.pathname === "/";
    return keyless ? " (opened from the disk, a page needs the whole address with its key)" : "";
  }

  /** Count the seconds down to the next try. */
  _wait(what) {
    let seconds = RETRY_SECONDS[Math.min(this._losses++, RETRY_SECONDS.length - 1)];
    const count = () => {
      if (seconds === 0) {
        this._open();
        return;
      }
      this._tell(`${what}, trying again in ${seconds} s`, true);
      seconds--;
      setTimeout(count, 1000);
    };
    count();
  }
}

/** JSON of a stranger's. */
function parsed(text) {
  if (typeof text !== "string" || text.length > LONGEST_MESSAGE) {
    throw new Error("a message is no text, or too long");
  }
  try {
    return JSON.parse(text);
  } catch {
    throw new Error(`a message is no JSON: "${text.slice(0, 30)}"`);
  }
}

/** Messages of the page around this one; of the named origins alone. */
class FrameMessages {
  constructor(origins, driver, tell) {
    this._origins = origins;
    this._driver = driver;
    this._tell = tell;
    this._channels = new Map(); // of the origins
    this._warned = false;
    if (origins.length === 0) return;
    window.addEventListener("message", (event) => this._take(event));
    if (window.parent === window) return;
    const layout = driver.avatar.layout;
    for (const origin of origins) {
      window.parent.postMessage({ type: "ready", ...DRIVE, layout }, origin);
    }
  }

  _take({ data, origin, source }) {
    if (!this._origins.includes(origin)) {
      if (!this._warned) console.warn(`rgbavatar: messages from ${origin} are not listened to.`);
      this._warned = true;
      return;
    }
    const answer = (message) => source?.postMessage(message, origin);
    try {
      if (this._act(data)) return;
      if (!this._channels.has(origin)) {
        this._channels.set(origin, new DriveChannel(this._driver, answer, true));
      }
      const status = this._channels.get(origin).take(data);
      if (status !== null) this._tell(status, false);
    } catch (error) {
      answer({ type: "error", text: error.message });
    }
  }

  /** What only a page around this one may ask for; whether it was that. */
  _act(message) {
    const { avatar } = this._driver;
    if (message?.type === "orbit") avatar.orbit(message.yaw, message.pitch);
    else if (message?.type === "pause") avatar.performance.pause();
    else if (message?.type === "play") {
      if (avatar.performance.length === 0) throw new Error("this page has no performance");
      avatar.performance.play();
    } else return false;
    return true;
  }
}
