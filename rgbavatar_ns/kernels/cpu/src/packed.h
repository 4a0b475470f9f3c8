// Packed Gaussians to splats: sixteen at a time, in registers from the bases to the image.
#pragma once

#include "halves.h"
#include "morphed.h"
#include "packed_layout.h"

namespace rgbavatar::RGBAVATAR_ISA {

// base + sum_k weight_k basis_k of kColumns columns; meanwhile begins to fetch the same of the next
// block, which is `stride` on: processors by themselves fetch ahead within a page only.
template <int kColumns>
static RGBAVATAR_MEMBER void morph_columns(const float* base, const uint16_t* basis, int bases,
                                           int64_t stride, const float* weights,
                                           Wide out[kColumns]) {
  for (int c = 0; c < kColumns; ++c) out[c] = load_wide(base + c * kLanes);
  for (int k = 0; k < bases; ++k, basis += kColumns * kLanes) {
    const Wide weight(weights[k]);
    for (int c = 0; c < kColumns; ++c) {
      __builtin_prefetch(basis + stride + c * kLanes);
      Wide value;
      load_halves(value, basis + c * kLanes);
      out[c] = out[c] + value * weight;
    }
  }
}

static void project_packed(const PackedScene& scene, const float* camera_floats, int begin, int end,
                           const Projected& out) {
  static_assert(kLanes == kPackedLanes, "a block is as wide as the loops");
  const Camera camera = camera_from(camera_floats, scene.width, scene.height);
  const int bases = scene.bases;
  const int64_t stride = int64_t(bases) * kPackedMorphed * kLanes;
  for (int first = begin; first < end; first += kLanes) {
    const int64_t block = first / kLanes;
    const float* base = scene.base + block * kPackedColumns * kLanes;
    const uint16_t* basis = scene.basis + block * stride;
    Wide position[3], rotation[4], color[3];
    const float* weights = scene.weights;
    morph_columns<3>(base + kPackedPosition * kLanes, basis, bases, stride, weights, position);
    basis += bases * 3 * kLanes;
    morph_columns<4>(base + kPackedRotation * kLanes, basis, bases, stride, weights + bases, rotation);
    basis += bases * 4 * kLanes;
    morph_columns<3>(base + kPackedColor * kLanes, basis, bases, stride, weights + 2 * bases, color);
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
