// Posing as Python sees it; shapes have been checked by kernels/posing.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <tuple>

#include "posing.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Input = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Joints = std::array<int, rgbavatar::kPosedJoints>;

// A Posing; all tensors are copied. `joints` are where theta's turns begin, `layers` are (W, b).
struct PosingOfTheta {
  rgbavatar::Posing posing;

  PosingOfTheta(const std::array<int, 6>& parts, const Joints& joints,
                const Joints& parents, const Input& rest,
                const Input& directions, const Input& joints_at_rest, const Input& joint_directions,
                const Input& skinning, bool only_joints, const Input& low, const Input& high,
                const std::vector<std::tuple<int, int, bool>>& features,
                const std::vector<std::tuple<Input, Input>>& layers)
      : posing(theta_parts(parts, joints),
               head(parts, parents, rest, directions, joints_at_rest, joint_directions, skinning,
                    only_joints),
               low.data(), high.data(), features_of(features), layers_of(layers)) {}

  static rgbavatar::ThetaParts theta_parts(const std::array<int, 6>& parts,
                                           const Joints& joints) {
    rgbavatar::ThetaParts out = {parts[0], parts[1], parts[2], parts[3], parts[4], parts[5], {}};
    std::copy(joints.begin(), joints.end(), out.joints);
    return out;
  }

  static rgbavatar::HeadInput head(const std::array<int, 6>& parts,
                                   const Joints& parents,
                                   const Input& rest, const Input& directions,
                                   const Input& joints_at_rest, const Input& joint_directions,
                                   const Input& skinning, bool only_joints) {
    rgbavatar::HeadInput out = {int(rest.shape(1)),
                                int(directions.shape(0)) - parts[2] - parts[4],
                                rest.data(),
                                directions.data(),
                                joints_at_rest.data(),
                                joint_directions.data(),
                                skinning.data(),
                                {},
                                only_joints};
    std::copy(parents.begin(), parents.end(), out.parents);
    return out;
  }

  static std::vector<rgbavatar::Feature> features_of(
      const std::vector<std::tuple<int, int, bool>>& features) {
    std::vector<rgbavatar::Feature> out;
    for (const auto& [start, count, turn] : features) out.push_back({start, count, turn});
    return out;
  }

  static std::vector<rgbavatar::Layer> layers_of(
      const std::vector<std::tuple<Input, Input>>& layers) {
    std::vector<rgbavatar::Layer> out;
    for (const auto& [weight, bias] : layers) {
      const size_t rows = weight.shape(0), columns = weight.shape(1);
      rgbavatar::Layer layer = {std::vector<float>(rows * columns),
                                std::vector<float>(bias.data(), bias.data() + rows)};
      for (size_t row = 0; row < rows; ++row)
        for (size_t column = 0; column < columns; ++column)
          layer.weight[column * rows + row] = weight.data()[row * columns + column];
      out.push_back(std::move(layer));
    }
    return out;
  }

  void run(const Input& theta, const Output& weights, const Output& vertices, int threads,
           const std::string& instruction_set) const {
    posing.run(theta.data(), weights.data(), vertices.data(), threads, instruction_set);
  }
};

}  // namespace

void bind_posing(nb::module_& m) {
  nb::class_<PosingOfTheta>(m, "Posing")
      .def(nb::init<const std::array<int, 6>&, const Joints&, const Joints&, const Input&,
                    const Input&, const Input&, const Input&, const Input&, bool, const Input&,
                    const Input&, const std::vector<std::tuple<int, int, bool>>&,
                    const std::vector<std::tuple<Input, Input>>&>(),
           "parts"_a, "joints"_a, "parents"_a, "rest"_a.noconvert(), "directions"_a.noconvert(),
           "joints_at_rest"_a.noconvert(), "joint_directions"_a.noconvert(),
           "skinning"_a.noconvert(), "only_joints"_a, "low"_a.noconvert(), "high"_a.noconvert(),
           "features"_a, "layers"_a)
      .def_prop_ro("num_weights", [](const PosingOfTheta& p) { return p.posing.num_weights(); })
      .def_prop_ro("num_vertices", [](const PosingOfTheta& p) { return p.posing.num_vertices(); })
      .def("run", &PosingOfTheta::run, "theta"_a.noconvert(), "weights"_a.noconvert(),
           "vertices"_a.noconvert(), "threads"_a, "instruction_set"_a, nb::call_guard<nb::gil_scoped_release>());
}
