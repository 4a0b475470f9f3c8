// Packed Gaussians to splats: sixteen at a time, in registers from the bases to the image.
#pragma once

#include "halves.h"
#include "morphed.h"
#include "packed_layout.h"

namespace rgbavatar::RGBAVATAR_ISA {

// Begins to fetch what is read next, of the next block: processors by themselves fetch ahead within
// a page only.
template <int kNumbers, typename Number>
RGBAVATAR_FUNCTION void fetch_ahead(const Number* from) {
  for (int i = 0; i < kNumbers; i += 64 / int(sizeof(Number))) __builtin_prefetch(from + i);
}

// base + sum_k weight_k basis_k of three columns; `stride` leads to the next block.
static RGBAVATAR_MEMBER void morph_halves(const float* base, const uint16_t* basis, int bases,
                                          int64_t stride, const float* weights, Wide out[3]) {
  for (int c = 0; c < 3; ++c) out[c] = load_wide(base + c * kLanes);
  for (int k = 0; k < bases; ++k, basis += 3 * kLanes) {
    fetch_ahead<3 * kLanes>(basis + stride);
    const Wide weight(weights[k]);
    for (int c = 0; c < 3; ++c) {
      Wide value;
      load_halves(value, basis + c * kLanes);
      out[c] = out[c] + value * weight;
    }
  }
}

// The same of as many columns whose numbers share a word, in units of the block.
template <int kColumns, int kBits>
static RGBAVATAR_MEMBER void morph_words(const float* base, const int32_t* basis, int bases,
                                         int64_t stride, const float* weights, const float* units,
                                         Wide out[kColumns]) {
  for (int c = 0; c < kColumns; ++c) out[c] = load_wide(base + c * kLanes);
  for (int k = 0; k < bases; ++k, basis += kLanes) {
    fetch_ahead<kLanes>(basis + stride);
    const Wide weight(weights[k] * units[k]);
    const WideInt word = load_ints(basis);
    for (int c = 0; c < kColumns; ++c) {
      const WideInt value = (word << WideInt(32 - kBits * (c + 1))) >> WideInt(32 - kBits);
      out[c] = out[c] + to_floats(value) * weight;
    }
  }
}

static void project_packed(const PackedScene& scene, const float* camera_floats, int begin, int end,
                           const Projected& out) {
  static_assert(kLanes == kPackedLanes, "a block is as wide as the loops");
  const Camera camera = camera_from(camera_floats, scene.width, scene.height);
  const int bases = scene.bases;
  const int64_t half_stride = int64_t(bases) * kPackedHalves * kLanes;
  const int64_t word_stride = int64_t(bases) * kPackedWords * kLanes;
  for (int first = begin; first < end; first += kLanes) {
    const int64_t block = first / kLanes;
    const float* base = scene.base + block * kPackedColumns * kLanes;
    const int32_t* words = scene.words + block * word_stride;
    const float* units = scene.word_units + block * kPackedWords * bases;
    Wide position[3], rotation[4], color[3];
    morph_halves(base + kPackedPosition * kLanes, scene.halves + block * half_stride, bases,
                 half_stride, scene.half_weights, position);
    morph_words<4, kRotationBits>(base + kPackedRotation * kLanes, words, bases, word_stride,
                                  scene.weights, units, rotation);
    morph_words<3, kColorBits>(base + kPackedColor * kLanes, words + bases * kLanes, bases,
                               word_stride, scene.weights, units + bases, color);
    const auto column = [&](int c) __attribute__((always_inline)) {
      return load_wide(base + c * kLanes);
    };
    const float* rows[kLanes];
    for (int lane = 0; lane < kLanes; ++lane)
      rows[lane] = scene.frames + int64_t(scene.triangle[first + lane]) * kFrameFloats;
    const FrameLanes frame =
        frames_of_rows(rows, column(kPackedBarycentric), column(kPackedBarycentric + 1));
    const Vec3<Wide> scale = {column(kPackedScale), column(kPackedScale + 1),
                              column(kPackedScale + 2)};
    GaussianInput<Wide> gaussian;
    to_world(frame, {position[0], position[1], position[2]}, rotation, scale, gaussian);
    gaussian.opacity = column(kPackedOpacity);
    project_lanes(scene.width, scene.height, camera, gaussian,
                  color_of_feature({color[0], color[1], color[2]}), nullptr, first, kLanes, out);
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
