// Two pictures under the window of structural similarity (SSIM).
#pragma once

#include <cstdint>

namespace rgbavatar {

constexpr int kTaps = 11;      // of the window, along each side
constexpr int kMeans = 4;      // under it: of x, y, x^2 + y^2 and x y
constexpr int kSlopes = 3;     // of SSIM, by the means of x, of the squares and of the product
constexpr int kChannels = 3;   // of a pixel, one after another
constexpr int kSlopeMargin = (kTaps - 1) * kChannels;
constexpr int kSimilarityLanes = 16;

// Rows are counted in floats, not in pixels.
struct SimilarityScene {
  int width, height;
  const float *x, *y;   // [height, width]
  const float* window;  // [kTaps]
  float c1, c2;
  int stride;     // of a row of slopes or of scratch: room for a margin on both sides
  float* slopes;  // [height - kTaps + 1, kSlopes, stride], zero in the margins; null: none wanted

  int rows() const { return height - kTaps + 1; }
  int columns() const { return width - kSlopeMargin; }
};

// Floats of a thread's scratch for rows of a stride.
constexpr int64_t similarity_scratch(int64_t stride) { return (kTaps + 1) * kMeans * stride; }

}  // namespace rgbavatar
