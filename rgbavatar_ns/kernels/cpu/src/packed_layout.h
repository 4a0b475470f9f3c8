// Morphed Gaussians as pictures alone need them: what no picture shows is left out, and what the
// bases change is kept in 16 bits or less a number, in the order in which it is read.
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
// What each basis changes: where a Gaussian is, as columns of sixteen halves, since a sharp edge shows
// a tenth of a pixel; its rotation and its colour feature as sixteen words each, whose bits are a
// signed number for each component, the first one in the lowest.
constexpr int kPackedHalves = 3;
constexpr int kPackedWords = 2;
constexpr int kRotationBits = 8;
constexpr int kColorBits = 10;

// One picture of such Gaussians.
struct PackedScene {
  int bases, width, height;
  const float* base;          // [blocks, kPackedColumns, 16]
  const uint16_t* halves;     // [blocks, K, kPackedHalves, 16]
  const int32_t* words;       // [blocks, kPackedWords, K, 16]
  const float* word_units;    // [blocks, kPackedWords, K]: how much a number's 1 is
  const int32_t* triangle;    // [blocks, 16]
  const float* half_weights;  // [K], over the halves' units
  const float* weights;       // [K]
  const float* frames;        // [U, kFrameFloats]
};

}  // namespace rgbavatar
