// Colours that depend on where they are seen from: real spherical harmonics of degree 1 to 3.
#pragma once

#include <cstdint>

namespace rgbavatar {

constexpr int kMostHarmonics = 16;

struct HarmonicScene {
  int images, count, harmonics;  // harmonics: 4, 9 or 16
  const float* coefficients;     // [1 or images, count, harmonics, 3]
  int64_t image_stride;          // of the coefficients; 0 where images share them
  const float* directions;       // [images, count, 3], of length 1
};

}  // namespace rgbavatar
