#include "posing.h"

#include <algorithm>
#include <cmath>

#include "team.h"

namespace rgbavatar {

namespace {

constexpr int kBlocksATime = 32;
constexpr float kRoom = 0.05f;  // beyond a number that never moved; weight_network.py

// R - I of an axis-angle vector by Rodrigues' formula; nothing of no turn.
void turn_of(const float* v, float out[9]) {
  const float x = v[0], y = v[1], z = v[2], angle = std::sqrt(x * x + y * y + z * z);
  const float half = std::sin(0.5f * angle);
  const float along_cross = angle > 0.0f ? std::sin(angle) / angle : 1.0f;
  const float along_outer = angle > 0.0f ? 2.0f * (half / angle) * (half / angle) : 0.5f;
  const float less = -2.0f * half * half;  // cos(angle) - 1
  const float cross[9] = {0.0f, -z, y, z, 0.0f, -x, -y, x, 0.0f};
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) {
      const int k = row * 3 + column;
      out[k] = (row == column ? less : 0.0f) + along_outer * v[row] * v[column] +
               along_cross * cross[k];
    }
}

// A number as it is within what training saw; beyond, ever less far.
float softly_within(float value, float low, float high) {
  if (!(low <= high)) return value;
  const float room = high - low + kRoom;
  const float nearest = std::min(std::max(value, low), high);
  return nearest + room * std::tanh((value - nearest) / room);
}

}  // namespace

Posing::Posing(const ThetaParts& parts, const HeadInput& head, const float* low, const float* high,
               std::vector<Feature> features, std::vector<Layer> layers)
    : parts_(parts),
      vertices_(head.vertices),
      blocks_((head.vertices + kPosedLanes - 1) / kPosedLanes),
      correctives_(head.correctives),
      only_joints_(head.only_joints),
      joints_(head.joints, head.joints + 3 * kPosedJoints),
      joint_directions_(head.joint_directions,
                        head.joint_directions + parts.num_expressions * 3 * kPosedJoints),
      low_(low, low + parts.size),
      high_(high, high + parts.size),
      features_(std::move(features)),
      layers_(std::move(layers)) {
  std::copy(head.parents, head.parents + kPosedJoints, parents_);
  const int count = parts.num_expressions + parts.num_eyelids + head.correctives;
  rest_.reserve(size_t(blocks_) * 3 * kPosedLanes);
  skinning_.reserve(size_t(blocks_) * kPosedJoints * kPosedLanes);
  // Columns of sixteen; the last block is filled with zeros. Tells whether any is another number.
  const auto columns = [&](const float* from, int block, int rows, float* to) {
    bool any = false;
    for (int row = 0; row < rows; ++row)
      for (int lane = 0; lane < kPosedLanes; ++lane) {
        const int vertex = block * kPosedLanes + lane;
        const float value = vertex < vertices_ ? from[int64_t(row) * vertices_ + vertex] : 0.0f;
        to[row * kPosedLanes + lane] = value;
        any = any || value != 0.0f;
      }
    return any;
  };
  std::vector<float> kept;
  float column[3 * kPosedLanes];
  for (int block = 0; block < blocks_; ++block) {
    columns(head.rest, block, 3, rest_.data() + size_t(block) * 3 * kPosedLanes);
    columns(head.skinning, block, kPosedJoints,
            skinning_.data() + size_t(block) * kPosedJoints * kPosedLanes);
    first_.push_back(int64_t(coefficient_of_.size()));
    for (int i = 0; i < count; ++i) {
      if (!columns(head.directions + int64_t(i) * 3 * vertices_, block, 3, column)) continue;
      coefficient_of_.push_back(i);
      kept.insert(kept.end(), column, column + 3 * kPosedLanes);
    }
  }
  first_.push_back(int64_t(coefficient_of_.size()));
  directions_.reserve(kept.size());
  std::copy(kept.begin(), kept.end(), directions_.data());
}

int Posing::num_weights() const {
  if (!layers_.empty()) return int(layers_.back().bias.size());
  int count = 0;
  for (const Feature& feature : features_) count += feature.turn ? 6 : feature.count;
  return count;
}

void Posing::run(const float* theta, float* weights, float* vertices, int threads,
                 const std::string& instruction_set) const {
  const Kernels* kernels = kernels_for(instruction_set);
  std::vector<float> coefficients(size_t(parts_.num_expressions) + parts_.num_eyelids + correctives_);
  if (!only_joints_) {
    std::copy_n(theta + parts_.expression, parts_.num_expressions, coefficients.begin());
    std::copy_n(theta + std::max(parts_.eyelids, 0), parts_.num_eyelids,
                coefficients.begin() + parts_.num_expressions);
  }
  float moves[kPosedJoints * 12];
  move_joints(theta, moves, coefficients.data());
  const PosedMesh mesh = {vertices_,
                          rest_.data(),
                          skinning_.data(),
                          first_.data(),
                          coefficient_of_.data(),
                          directions_.data(),
                          coefficients.data(),
                          moves,
                          theta + parts_.translation};
  Team team(threads);
  const int parts = (blocks_ + kBlocksATime - 1) / kBlocksATime;
  team.run(parts + 1, [&](int64_t item, int) {
    if (item == 0) return weigh(theta, weights);
    const int begin = int(item - 1) * kBlocksATime;
    kernels->pose_vertices(mesh, begin, std::min(begin + kBlocksATime, blocks_), vertices);
  });
}

// How each joint moves a point of the head at rest, all above it included; correctives follow the
// turns of all joints but the root.
void Posing::move_joints(const float* theta, float* moves, float* coefficients) const {
  float joints[3 * kPosedJoints];
  std::copy(joints_.begin(), joints_.end(), joints);
  for (int e = 0; e < parts_.num_expressions; ++e)
    for (int k = 0; k < 3 * kPosedJoints; ++k)
      joints[k] += coefficients[e] * joint_directions_[e * 3 * kPosedJoints + k];
  float* corrective = coefficients + parts_.num_expressions + parts_.num_eyelids;
  for (int joint = 0; joint < kPosedJoints; ++joint) {
    float turn[9], local[12];
    turn_of(theta + parts_.joints[joint], turn);
    if (joint > 0 && correctives_ > 0) std::copy(turn, turn + 9, corrective + 9 * (joint - 1));
    // About its joint alone, a bone moves x by T (x - j).
    for (int row = 0; row < 3; ++row) {
      float shift = 0.0f;
      for (int k = 0; k < 3; ++k) {
        local[row * 4 + k] = turn[row * 3 + k];
        shift -= turn[row * 3 + k] * joints[k * kPosedJoints + joint];
      }
      local[row * 4 + 3] = shift;
    }
    float* move = moves + joint * 12;
    std::copy(local, local + 12, move);
    if (parents_[joint] < 0) continue;
    // First the bone, then all above it: m + M(x + m) = M(x) + m + A m.
    const float* above = moves + parents_[joint] * 12;
    for (int row = 0; row < 3; ++row)
      for (int k = 0; k < 4; ++k) {
        float sum = above[row * 4 + k] + local[row * 4 + k];
        for (int i = 0; i < 3; ++i) sum += above[row * 4 + i] * local[i * 4 + k];
        move[row * 4 + k] = sum;
      }
  }
}

void Posing::weigh(const float* theta, float* weights) const {
  std::vector<float> seen(parts_.size), values, sums;
  for (int i = 0; i < parts_.size; ++i) seen[i] = softly_within(theta[i], low_[i], high_[i]);
  for (const Feature& feature : features_) {
    const float* from = seen.data() + feature.start;
    if (!feature.turn) {
      values.insert(values.end(), from, from + feature.count);
      continue;
    }
    float turn[9];
    turn_of(from, turn);
    for (int k = 0; k < 6; ++k) values.push_back(turn[k] + (k == 0 || k == 4 ? 1.0f : 0.0f));
  }
  for (size_t i = 0; i < layers_.size(); ++i) {
    const size_t width = layers_[i].bias.size();
    sums = layers_[i].bias;
    const float* weight = layers_[i].weight.data();
    for (size_t in = 0; in < values.size(); ++in, weight += width)
      for (size_t out = 0; out < width; ++out) sums[out] += values[in] * weight[out];
    const bool last = i + 1 == layers_.size();
    for (float& sum : sums) sum = last ? sum : std::max(sum, 0.0f);
    values.swap(sums);
  }
  std::copy(values.begin(), values.end(), weights);
}

}  // namespace rgbavatar
