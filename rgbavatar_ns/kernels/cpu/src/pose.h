// Vertices of a posed head, sixteen at a time: shape directions, then linear blend skinning.
#pragma once

#include "posing_layout.h"
#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

// Writes the vertices [V, 3] of the blocks [begin, end).
static void pose_vertices(const PosedMesh& mesh, int begin, int end, float* vertices) {
  static_assert(kLanes == kPosedLanes, "a block is as wide as the loops");
  for (int block = begin; block < end; ++block) {
    Wide shaped[3], move[12];
    for (int c = 0; c < 3; ++c) shaped[c] = load_wide(mesh.rest + (int64_t(block) * 3 + c) * kLanes);
    for (int64_t i = mesh.first[block]; i < mesh.first[block + 1]; ++i) {
      const Wide coefficient(mesh.coefficients[mesh.coefficient_of[i]]);
      for (int c = 0; c < 3; ++c)
        shaped[c] = shaped[c] + load_wide(mesh.directions + (i * 3 + c) * kLanes) * coefficient;
    }
    for (int k = 0; k < 12; ++k) move[k] = Wide(0.0f);
    for (int joint = 0; joint < kPosedJoints; ++joint) {
      const Wide weight =
          load_wide(mesh.skinning + (int64_t(block) * kPosedJoints + joint) * kLanes);
      for (int k = 0; k < 12; ++k) move[k] = move[k] + weight * Wide(mesh.moves[joint * 12 + k]);
    }
    float posed[3][kLanes];
    for (int row = 0; row < 3; ++row) {
      const Wide* a = move + 4 * row;
      const Wide moved = a[0] * shaped[0] + a[1] * shaped[1] + a[2] * shaped[2] + a[3];
      store(shaped[row] + (Wide(mesh.translation[row]) + moved), posed[row]);
    }
    const int first = block * kLanes;
    for (int lane = 0; lane < kLanes && first + lane < mesh.vertices; ++lane)
      for (int c = 0; c < 3; ++c) vertices[int64_t(first + lane) * 3 + c] = posed[c][lane];
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
