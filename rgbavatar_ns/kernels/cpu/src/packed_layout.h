// Morphed Gaussians as pictures alone need them: what no picture shows is left out, and what the
// bases change is kept in half precision, in the order in which it is read.
#pragma once

#include "layout.h"

namespace rgbavatar {

// Sixteen Gaussians are a block. Its base is columns of sixteen floats: position, rotation, colour
// feature, scale, opacity, and the second and third barycentric coordinate.
constexpr int kPackedLanes = 16;
enum {
  kPackedPosition = 0,
  kPackedRotation = 3,
  kPackedColor = 7,
  kPackedScale = 10,
  kPackedOpacity = 13,
  kPackedBarycentric = 14,
  kPackedColumns = 16
};
// What the bases change, as many columns of sixteen halves for each of them.
constexpr int kPackedMorphed = 10;

// One picture of such Gaussians.
struct PackedScene {
  int bases, width, height;
  const float* base;        // [blocks, kPackedColumns, 16]
  const uint16_t* basis;    // of a block, one kind after the other: [K, 3 or 4, 16]
  const int32_t* triangle;  // [blocks, 16]
  const float* weights;     // [kinds, K], over the bases' units
  const float* frames;      // [U, kFrameFloats]
};

}  // namespace rgbavatar
