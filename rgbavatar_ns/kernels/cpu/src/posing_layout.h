// A head mesh as it is posed for one picture: sixteen vertices are a block.
#pragma once

#include <cstdint>

namespace rgbavatar {

constexpr int kPosedLanes = 16;
constexpr int kPosedJoints = 5;

struct PosedMesh {
  int vertices;
  const float* rest;             // [blocks, 3, 16]
  const float* skinning;         // [blocks, kPosedJoints, 16]
  const int64_t* first;          // [blocks + 1], into the directions: those that move a block
  const int32_t* coefficient_of;  // of each direction
  const float* directions;       // [.., 3, 16]
  const float* coefficients;
  const float* moves;            // [kPosedJoints, 3, 4]: a joint moves x by A x + s
  const float* translation;      // [3]
};

}  // namespace rgbavatar
