/** An animatable Gaussian avatar on a canvas. Written by `rgbavatar export --format web-module`. */

/** Numbers in a plain or a typed array. */
export type Numbers = ArrayLike<number>;

/** A run of theta's numbers: blend weights, an axis-angle in radians, a translation in metres. */
export interface ThetaField {
  name: string;
  size: number;
  form: "linear" | "axis_angle" | "translation";
}

/** Of the head; axes: x the subject's left, y up, z out of the face. */
export interface Pose {
  /** Axis-angle in radians; the identity looks straight ahead. */
  rotation?: Numbers | null;
  /** In metres, from where the head is first. */
  translation?: Numbers | null;
}

/** A camera in the head's world (metres); camera axes: x right, y down, z forward. */
export interface Camera {
  /** World to camera, nine numbers row by row. */
  rotation: Numbers;
  translation: Numbers;
  /** In pixels, of a picture of width x height, which is stretched over the canvas. */
  focal: Numbers;
  principal: Numbers;
  width: number;
  height: number;
}

export interface Options {
  /** [r, g, b] in 0..1, or null for transparent; by default the avatar's own. */
  background?: Numbers | null;
  /** Pointers turn, move and zoom; true. */
  controls?: boolean;
  /** Draws by itself after every change; true. Otherwise `draw` does. */
  automatic?: boolean;
  /** What draws; by default WebGPU where the browser has it, and WebGL2 else. */
  renderer?: "webgpu" | "webgl2";
}

/** The film that the avatar brings, if any. */
export interface Performance {
  /** In frames; 0 where there is none. */
  readonly length: number;
  readonly framesPerSecond: number;
  readonly playing: boolean;
  /** In frames, with a fraction. */
  readonly place: number;
  /** 1 is the film's own. */
  speed: number;
  play(): void;
  pause(): void;
  seek(place: number): void;
}

/**
 * Events: "drawn" after a picture, "lost" when the graphics are taken away, "restored" when they
 * are back. What is no theta, pose, camera or colour throws TypeError or RangeError and changes
 * nothing.
 */
export class RGBAvatar extends EventTarget {
  private constructor();

  /** From an address, the bytes of an avatar file, or the `data` of another avatar; drawn once. */
  static load(
    source: string | URL | ReadableStream<Uint8Array> | { data: unknown },
    canvas: HTMLCanvasElement,
    options?: Options,
  ): Promise<RGBAvatar>;

  /**
   * The pose of a rigid 4 x 4 matrix, column by column, before a camera with x right, y up and z
   * backward, such as MediaPipe's facialTransformationMatrixes[0].data (centimetres: 0.01).
   */
  static poseOfMatrix(matrix: Numbers, metresPerUnit?: number): Required<Pose>;

  /**
   * The camera of a view and a projection matrix as OpenGL has them, column by column, such as
   * three.js's camera.matrixWorldInverse.elements and camera.projectionMatrix.elements.
   */
  static openGLCamera(view: Numbers, projection: Numbers, width: number, height: number): Camera;

  readonly canvas: HTMLCanvasElement;
  /** For `load` on another canvas. */
  readonly data: unknown;
  /** What draws. */
  readonly rendererKind: "webgpu" | "webgl2";
  readonly performance: Performance;
  /** Resolves when all of the file is there; the first picture is drawn long before. */
  readonly complete: Promise<void>;
  /** Theta's fields in order. */
  readonly layout: readonly ThetaField[];
  readonly expressionNames: readonly string[];
  /** The names that `setARKit` knows; none where the head has no face that it finds. */
  readonly arkitNames: readonly string[];
  /** Theta of the calm face that is shown first. */
  readonly neutralTheta: number[];
  /** What is shown. */
  readonly theta: number[];
  /** Weights of the learned bases in the last picture. */
  readonly psi: number[];
  /** Yaw and pitch in radians as the last picture's camera sees the head. */
  readonly turnSeen: readonly [number, number];
  /** The middle of the head in its world, in metres, as in the last picture. */
  readonly headCentre: [number, number, number];
  /** Drawn so far. */
  readonly pictures: number;
  /** What is left out while something moves slowly, in words; empty where nothing is. */
  readonly pace: string;
  /** The share of the Gaussians that is drawn, the most needed ones first, in (0, 1]; 1. */
  detail: number;
  get background(): number[] | null;
  set background(color: Numbers | null);

  /** Show a theta and pause the performance. */
  setTheta(theta: Numbers): void;

  /**
   * Show ARKit's blend shapes, held to 0..1, and a pose; what is missing is as in the calm face.
   * Unknown names are told once on the console, NaN counts as missing.
   */
  setARKit(coefficients: Record<string, number>, pose?: Pose | null): void;

  /** Hold weight k of the learned bases against the network; null lets it go. */
  holdWeight(k: number, value: number | null): void;
  isHeld(k: number): boolean;

  /** See the head from these angles in radians from the first camera; no farther than it holds. */
  orbit(yaw: number, pitch: number): void;

  /** See it through another program's camera; null: through its own again. */
  setCamera(camera: Camera | null): void;

  /** Fix the picture's size in pixels; without arguments it follows the canvas's place. */
  setSize(width?: number, height?: number): void;

  /** Have a new picture drawn with the next frame. */
  changed(): void;

  /** Draw now. */
  draw(): void;

  /** Free the graphics memory and all listeners; afterwards nothing is drawn. */
  dispose(): void;
}
