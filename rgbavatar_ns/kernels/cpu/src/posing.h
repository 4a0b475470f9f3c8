// Theta to blendshape weights and a posed mesh. In tensor operations a head and a small network are
// a hundred calls, which take longer than what they compute.
#pragma once

#include <string>
#include <vector>

#include "posing_layout.h"
#include "raster.h"

namespace rgbavatar {

// Where the parts of theta are; -1 in place of a part that it has not.
struct ThetaParts {
  int size, expression, num_expressions, eyelids, num_eyelids, translation;
  int joints[kPosedJoints];
};

// Numbers of theta as the network reads them: as they are, or an axis-angle vector as the first two
// rows of its matrix.
struct Feature {
  int start, count;
  bool turn;
};

// y = W x + b; the weights are kept as [in, out].
struct Layer {
  std::vector<float> weight, bias;
};

struct HeadInput {
  int vertices, correctives;
  const float* rest;              // [3, V]
  const float* directions;        // [expressions + eyelids + correctives, 3 V]
  const float* joints;            // [3, kPosedJoints]
  const float* joint_directions;  // [expressions, 3 kPosedJoints]
  const float* skinning;          // [kPosedJoints, V]
  int parents[kPosedJoints];
  bool only_joints;  // what theta says of shape moves no vertex
};

class Posing {
 public:
  // `low` and `high` [theta's size]: what training saw of each number, nothing where they cross.
  Posing(const ThetaParts& parts, const HeadInput& head, const float* low, const float* high,
         std::vector<Feature> features, std::vector<Layer> layers);

  int num_weights() const;
  int num_vertices() const { return vertices_; }
  int theta_size() const { return parts_.size; }

  // Writes weights [num_weights()] and vertices [V, 3].
  void run(const float* theta, float* weights, float* vertices, int threads,
           const std::string& instruction_set) const;

 private:
  void weigh(const float* theta, float* weights) const;
  void move_joints(const float* theta, float* moves, float* coefficients) const;

  ThetaParts parts_;
  int vertices_, blocks_, correctives_;
  int parents_[kPosedJoints];
  bool only_joints_;
  std::vector<float> joints_, joint_directions_, low_, high_;
  std::vector<Feature> features_;
  std::vector<Layer> layers_;
  std::vector<int64_t> first_;
  std::vector<int32_t> coefficient_of_;
  Buffer<float> rest_, skinning_, directions_;
};

}  // namespace rgbavatar
