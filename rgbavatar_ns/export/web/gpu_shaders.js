"use strict";
/* The same three programs as shaders.js for WebGPU, line by line where the languages allow it. */

const GROUP_SIZE = 64; // Gaussians; what every GPU's groups are whole parts of

/** What all three know of the picture; `GPURenderer._describe` fills it in this order. */
const GPU_SCENE = `
struct Scene {
  cameraX: vec4f, cameraY: vec4f, cameraZ: vec4f, // rows of world to camera, translation last
  focal: vec2f, principal: vec2f, slopeLow: vec2f, slopeHigh: vec2f,
  background: vec4f,  // premultiplied
  pictureSize: vec2f, // in pixels, as large as the canvas or smaller
  canvasSize: vec2f,
  count: u32, numBases: u32,
  variant: u32,       // of tangent frames: 0 normalized, 1 raw, 2 orthonormal
  stride: u32,        // Gaussians from one table to the next
}
@group(0) @binding(0) var<uniform> scene: Scene;
`;

/** A Gaussian in the picture. */
const GPU_BOX = `
struct Box {
  place: vec4f, // centre and longer half axis in pixels
  shape: vec4f, // other half axis in pixels, both in deviations, opacity
  shade: vec4f, // colour
}
`;

/** One invocation a Gaussian: base plus weighted bases, activated, placed, projected. */
const GPU_PLACE = `${GPU_SCENE}${GPU_BOX}
struct Face {
  corners: vec4u, // three vertices' numbers, length at rest or 0 (float's bits)
  edges: vec4f,   // to the frame
}
// Tables: deviations and opacity; quaternion; colour and triangle; position in the triangle's
// tangent frame; two barycentric coordinates and growth of this level of detail.
@group(0) @binding(1) var<storage, read> base: array<vec4f>;
@group(0) @binding(2) var<storage, read> bases: array<u32>; // of rotation, colour, position: bytes
@group(0) @binding(3) var<storage, read> weights: array<vec4f>; // psi times units, as the bases
@group(0) @binding(4) var<storage, read> vertices: array<vec4f>; // of the posed head
@group(0) @binding(5) var<storage, read> faces: array<Face>;
@group(0) @binding(6) var<storage, read_write> boxes: array<Box>;

fn turned(q: vec4f, v: vec3f) -> vec3f {
  let t = 2.0 * cross(q.yzw, v);
  return v + q.x * t + cross(q.yzw, t);
}

fn toCamera(v: vec3f) -> vec3f {
  return vec3f(dot(scene.cameraX.xyz, v), dot(scene.cameraY.xyz, v), dot(scene.cameraZ.xyz, v));
}

/** Basis k's part of a table, weighted. */
fn weighted(table: u32, k: u32, gaussian: u32) -> vec4f {
  let at = table * scene.numBases + k;
  return weights[at] * unpack4x8snorm(bases[at * scene.stride + gaussian]);
}

@compute @workgroup_size(${GROUP_SIZE})
fn main(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= scene.count) { return; }
  boxes[i] = Box(vec4f(0.0), vec4f(0.0), vec4f(0.0));

  let size = base[i];
  var rotation = base[scene.stride + i];
  let colorTriangle = base[2u * scene.stride + i];
  var color = colorTriangle.rgb;
  var local = base[3u * scene.stride + i].xyz;
  let on = base[4u * scene.stride + i];
  for (var k = 0u; k < scene.numBases; k++) {
    rotation += weighted(0u, k, i);
    color += weighted(1u, k, i).rgb;
    local += weighted(2u, k, i).xyz;
  }
  rotation = normalize(rotation);

  // The triangle's tangent frame: along u and v of the texture map, and the outward normal.
  let face = faces[u32(colorTriangle.w)];
  let a = vertices[face.corners.x].xyz;
  let b = vertices[face.corners.y].xyz;
  let c = vertices[face.corners.z].xyz;
  var u = b - a;
  var v = c - a;
  var normal = cross(u, v);
  let doubled = length(normal);
  if (doubled * doubled > 1e-10 * dot(u, u) * dot(v, v) + 1e-30) {
    normal /= doubled;
  } else { // without area: the world's axes
    u = vec3f(1.0, 0.0, 0.0); v = vec3f(0.0, 1.0, 0.0); normal = vec3f(0.0, 0.0, 1.0);
  }
  var tangent = face.edges.x * u + face.edges.y * v;
  var bitangent = face.edges.z * u + face.edges.w * v;
  if (scene.variant != 1u) { tangent = normalize(tangent); }
  if (scene.variant == 2u) { bitangent = cross(normal, tangent); }
  else if (scene.variant == 0u) { bitangent = normalize(bitangent); }

  let world = on.x * a + on.y * b + (1.0 - on.x - on.y) * c
    + local.x * tangent + local.y * bitangent + local.z * normal;
  // The rotation nearest to the frame that keeps the normal: tangent and bitangent turned back by
  // 90 degrees, averaged.
  let back = cross(bitangent, normal);
  let wished = tangent + select(back, -back, dot(back, tangent) < 0.0);
  let alongU = normalize(wished - dot(wished, normal) * normal);
  let frame = mat3x3f(alongU, cross(normal, alongU), normal);

  let rest = bitcast<f32>(face.corners.w);
  var follows = 1.0;
  if (rest > 0.0) { follows = sqrt(max(0.5 * doubled, 1e-16)) / rest; }
  let scale = size.xyz * on.z * follows;

  let centre = toCamera(world) + vec3f(scene.cameraX.w, scene.cameraY.w, scene.cameraZ.w);
  if (centre.z < 0.01 || size.w < 1.0 / 255.0) { return; }
  let slope = centre.xy / centre.z;
  let held = clamp(slope, scene.slopeLow, scene.slopeHigh);
  let perMetre = scene.focal / centre.z;
  var covariance = vec3f(0.3, 0.0, 0.3); // xx, xy, yy: the usual low-pass filter
  for (var axis = 0u; axis < 3u; axis++) {
    var along = vec3f(0.0);
    along[axis] = scale[axis];
    let seen = toCamera(frame * turned(rotation, along));
    let inImage = (seen.xy - held * seen.z) * perMetre;
    covariance += vec3f(inImage.x * inImage.x, inImage.x * inImage.y, inImage.y * inImage.y);
  }
  // The ellipse's longer half axis, where alpha falls below 1/255, and the length of the other.
  let middle = 0.5 * (covariance.x + covariance.z);
  let uneven = 0.5 * (covariance.x - covariance.z);
  let apart = length(vec2f(uneven, covariance.y));
  let angle = 0.5 * atan2(covariance.y, uneven + 1e-20);
  let reach = sqrt(2.0 * log(size.w * 255.0));
  let axes = reach * sqrt(vec2f(middle + apart, max(middle - apart, 0.3)));
  boxes[i] = Box(
    vec4f(scene.focal * slope + scene.principal, axes.x * vec2f(cos(angle), sin(angle))),
    vec4f(axes.y, reach, size.w, 0.0),
    vec4f(vec3f(0.5) + 0.28209479177387814 * color, 1.0),
  );
}`;

/** Each Gaussian is a box around the ellipse that may be seen of it. */
const GPU_DRAW = `${GPU_SCENE}${GPU_BOX}
@group(0) @binding(1) var<storage, read> order: array<u32>; // from far to near
@group(0) @binding(2) var<storage, read> boxes: array<Box>;

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) deviations: vec2f, // from the centre, along both axes
  @location(1) @interpolate(flat) colorOpacity: vec4f,
}

@vertex
fn corner(@builtin(vertex_index) number: u32) -> Corner {
  let box = boxes[order[number >> 2u]];
  let side = vec2f(f32(number & 1u) * 2.0 - 1.0, f32(number & 2u) - 1.0);
  var position = vec4f(2.0, 2.0, 2.0, 1.0); // not to be seen
  if (box.shape.x > 0.0) {
    let along = box.place.zw;
    let across = box.shape.x * normalize(vec2f(-along.y, along.x));
    let pixel = (box.place.xy + side.x * along + side.y * across) / scene.pictureSize;
    position = vec4f(2.0 * pixel.x - 1.0, 1.0 - 2.0 * pixel.y, 0.0, 1.0);
  }
  return Corner(position, side * box.shape.y, vec4f(box.shade.rgb, box.shape.z));
}

@fragment
fn shade(seen: Corner) -> @location(0) vec4f {
  let alpha = min(0.999, seen.colorOpacity.a * exp(-0.5 * dot(seen.deviations, seen.deviations)));
  if (alpha < 1.0 / 255.0) { discard; }
  return vec4f(seen.colorOpacity.rgb * alpha, alpha);
}`;

/** The picture over its background, whose colour is premultiplied as the result's is. */
const GPU_SHOW = `${GPU_SCENE}
@group(0) @binding(1) var picture: texture_2d<f32>;
@group(0) @binding(2) var linear: sampler;

@vertex
fn corner(@builtin(vertex_index) number: u32) -> @builtin(position) vec4f {
  return vec4f(select(-1.0, 3.0, number == 1u), select(-1.0, 3.0, number == 2u), 0.0, 1.0);
}

@fragment
fn shade(@builtin(position) at: vec4f) -> @location(0) vec4f {
  var seen = textureSampleLevel(picture, linear, at.xy / scene.canvasSize, 0.0);
  seen += (1.0 - seen.a) * scene.background;
  return vec4f(clamp(seen.rgb, vec3f(0.0), vec3f(seen.a)), seen.a); // more than alpha would glow
}`;
