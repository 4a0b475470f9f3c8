// The Python module. Arrays arrive through DLPack; shapes have been checked by functional.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <cmath>
#include <optional>
#include <tuple>

#include "packed_drawing.h"
#include "similarity.h"

namespace nb = nanobind;
using namespace nb::literals;

void bind_harmonics(nb::module_& m);  // harmonics_module.cpp
void bind_posing(nb::module_& m);     // posing_module.cpp

namespace {

#define RGBAVATAR_FUNCTION static inline
#include "../../shared/gaussian_math.h"

using Input = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;
using Sums = nb::ndarray<int64_t, nb::c_contig, nb::device::cpu>;
using Pixels = nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu>;

template <class Array>
auto pointer(const std::optional<Array>& array) {
  return array ? array->data() : nullptr;
}

// Tensors [B or 1, ...] as the loops see them.
rgbavatar::Attribute attribute(const Input& array) {
  int64_t row = 1;
  for (size_t i = 1; i < array.ndim(); ++i) row *= int64_t(array.shape(i));
  return {array.data(), array.shape(0) == 1 ? 0 : row};
}

// Gaussians of a batch; keeps the tensors alive.
struct Gaussians {
  Input means, quats, scales, opacities, colors;
  std::optional<Input> screen_offset;

  rgbavatar::Scene scene(int batch, int width, int height) const {
    return {batch,
            int(means.shape(1)),
            width,
            height,
            attribute(means),
            attribute(quats),
            attribute(scales),
            attribute(opacities),
            attribute(colors),
            screen_offset ? attribute(*screen_offset) : rgbavatar::Attribute{nullptr, 0}};
  }
};

// What both kinds of rendering offer to Python.
template <class Rendering>
struct Drawing {
  int threads;
  Rendering rendering;

  void draw(const Input& background, int first, const Output& image, const Output& alpha,
            const std::optional<Output>& depth) {
    rendering.draw(attribute(background), first, int(image.shape(0)), image.data(), alpha.data(),
                   pointer(depth), threads);
  }

  void average(const std::optional<Input>& images, const std::optional<Output>& weighted_sum,
               const std::optional<Output>& weight_sum, const Output& max_weight) {
    const rgbavatar::Attribute pixels =
        images ? attribute(*images) : rgbavatar::Attribute{nullptr, 0};
    rendering.average(pixels, images ? int(images->shape(3)) : 0, pointer(weighted_sum),
                      pointer(weight_sum), max_weight.data(), threads);
  }

  static void bind_draw(nb::class_<Drawing>& type) {
    type.def("draw", &Drawing::draw, "background"_a.noconvert(), "first"_a,
             "image"_a.noconvert(), "alpha"_a.noconvert(), "depth"_a.noconvert().none(),
             nb::call_guard<nb::gil_scoped_release>());
  }

  static void bind(nb::class_<Drawing>& type) {
    using Release = nb::call_guard<nb::gil_scoped_release>;
    bind_draw(type);
    type.def("average", &Drawing::average, "images"_a.noconvert().none(),
             "weighted_sum"_a.noconvert().none(), "weight_sum"_a.noconvert().none(),
             "max_weight"_a.noconvert(), Release());
  }
};

rgbavatar::Cameras cameras(const Input& world_to_camera, const Input& focal_px,
                           const Input& principal_point_px) {
  return {world_to_camera.data(), focal_px.data(), principal_point_px.data(),
          int(focal_px.shape(0))};
}

// A Rendering with the sizes that its later calls need.
struct Session : Drawing<rgbavatar::Rendering> {
  int batch, width, height;

  Session(const Gaussians& gaussians, const Input& world_to_camera, const Input& focal_px,
          const Input& principal_point_px, int batch, int width, int height, int threads,
          const std::string& instruction_set)
      : Drawing{threads,
                {gaussians.scene(batch, width, height),
                 cameras(world_to_camera, focal_px, principal_point_px), instruction_set, threads}},
        batch(batch),
        width(width),
        height(height) {}

  void backward(const Gaussians& gaussians, const Input& background,
                const std::optional<Input>& image_grad, const std::optional<Input>& alpha_grad,
                int threads, const Output& means, const Output& quats, const Output& scales,
                const Output& opacities, const Output& colors,
                const std::optional<Output>& screen_offset) {
    rendering.backward(gaussians.scene(batch, width, height), attribute(background),
                       pointer(image_grad), pointer(alpha_grad),
                       {means.data(), quats.data(), scales.data(), opacities.data(), colors.data(),
                        pointer(screen_offset)},
                       threads);
  }
};

// Morphed Gaussians with the mesh that carries them; keeps the tensors alive.
struct Morphed {
  Input position, rotation, color, log_scale, opacity_logit;
  std::optional<Input> basis_position, basis_rotation, basis_color;
  Input barycentric, edges_to_frame;
  std::optional<Input> rest_length;
  Indices triangle_vertices, triangle_of;
  int variant;

  rgbavatar::MorphedScene scene(const Input& weights, const Input& vertices, int width,
                                int height) const {
    return {int(weights.shape(0)),
            int(position.shape(0)),
            int(weights.shape(1)),
            width,
            height,
            int(vertices.shape(1)),
            int(triangle_vertices.shape(0)),
            variant,
            weights.data(),
            {position.data(), rotation.data(), color.data()},
            {pointer(basis_position), pointer(basis_rotation), pointer(basis_color)},
            log_scale.data(),
            opacity_logit.data(),
            vertices.data(),
            barycentric.data(),
            triangle_vertices.data(),
            triangle_of.data(),
            edges_to_frame.data(),
            pointer(rest_length),
            nullptr};
  }
};

// A parameter's value, Adam's two moments, and (rate, inverse_root, beta1, beta2, epsilon).
using AdamArrays = std::tuple<Output, Output, Output, std::array<float, 5>>;

rgbavatar::AdamGroup adam_group(const AdamArrays& arrays) {
  const auto& [value, first, second, n] = arrays;
  return {value.data(), first.data(), second.data(), n[0], n[1], n[2], n[3], n[4]};
}

// A MorphedRendering with the tensors that its later calls need.
struct MorphedSession : Drawing<rgbavatar::MorphedRendering> {
  Morphed blended;
  Input weights, vertices;
  int width, height;

  MorphedSession(const Morphed& blended, const Input& weights, const Input& vertices,
                 const Input& world_to_camera, const Input& focal_px,
                 const Input& principal_point_px, int width, int height, int threads,
                 const std::string& instruction_set)
      : Drawing{threads,
                {blended.scene(weights, vertices, width, height),
                 cameras(world_to_camera, focal_px, principal_point_px), instruction_set, threads}},
        blended(blended),
        weights(weights),
        vertices(vertices),
        width(width),
        height(height) {}

  // known [N] and sums [N, 5] together, or neither. Returns the loss and the rows that were filled.
  std::tuple<double, std::vector<int64_t>> forward_loss(const Pixels& images, const Input& background,
                      const std::optional<Flags>& known, const std::optional<Sums>& sums,
                      float threshold, int sight_images, bool over_background) {
    const rgbavatar::FirstSight sight = {pointer(known), pointer(sums), threshold, std::log2(threshold), sight_images,
                                         over_background};
    const double loss = rendering.forward_loss(images.data(), attribute(background),
                                               known ? &sight : nullptr, threads);
    return {loss, rendering.shown()};
  }

  void backward_adam(const std::vector<AdamArrays>& groups, const Output& weight_gradient,
              const std::optional<Output>& vertex_gradient) {
    const rgbavatar::MorphedScene scene = blended.scene(weights, vertices, width, height);
    if (groups.empty())
      return rendering.backward_adam(scene, nullptr, weight_gradient.data(), pointer(vertex_gradient),
                              threads);
    rgbavatar::MorphedOptimizer optimizer = {};
    for (int kind = 0; kind < rgbavatar::kMorphedKinds; ++kind) {
      optimizer.base[kind] = adam_group(groups[kind]);
      if (weights.shape(1) > 0)
        optimizer.basis[kind] = adam_group(groups[5 + kind]);
    }
    optimizer.log_scale = adam_group(groups[3]);
    optimizer.opacity_logit = adam_group(groups[4]);
    rendering.backward_adam(scene, &optimizer, weight_gradient.data(), pointer(vertex_gradient), threads);
  }
};

// Packed Gaussians; keeps what places them on the mesh.
struct Packed {
  Morphed mesh;
  rgbavatar::PackedGaussians gaussians;

  Packed(const Morphed& blended, const Input& weights, const Input& vertices, int threads)
      : mesh(blended), gaussians(blended.scene(weights, vertices, 1, 1), threads) {}

  size_t count() const { return gaussians.count(); }
  size_t bytes() const { return gaussians.bytes(); }
};

// A PackedRendering.
struct PackedSession : Drawing<rgbavatar::PackedRendering> {
  PackedSession(const Packed& packed, const Input& weights, const Input& vertices,
                const Input& world_to_camera, const Input& focal_px,
                const Input& principal_point_px, int width, int height, int threads,
                const std::string& instruction_set)
      : Drawing{threads,
                {packed.gaussians, packed.mesh.scene(weights, vertices, width, height),
                 cameras(world_to_camera, focal_px, principal_point_px), instruction_set, threads}} {
  }
};

// Pictures [B, H, W, 3] and a window [11]; the gradient by the first, like it, where one is given.
std::vector<double> mean_similarity(const Input& image, const Input& target, const Input& window,
                                    float c1, float c2, const std::optional<Output>& gradient,
                                    int threads, const std::string& instruction_set) {
  const rgbavatar::SimilarityScene scene = {int(image.shape(2)) * rgbavatar::kChannels,
                                            int(image.shape(1)),
                                            image.data(),
                                            target.data(),
                                            window.data(),
                                            c1,
                                            c2,
                                            0,
                                            nullptr};
  return rgbavatar::mean_similarity(scene, int(image.shape(0)), pointer(gradient), threads,
                                    instruction_set);
}

nb::dict constants() {
  using C = BlendingConstants;
  nb::dict out;
  out["NEAR_PLANE_M"] = C::kNearPlane;
  out["DILATION_PX2"] = C::kDilation;
  out["MAX_ALPHA"] = C::kMaxAlpha;
  out["MIN_ALPHA"] = C::kMinAlpha;
  out["MIN_TRANSMITTANCE"] = C::kMinTransmittance;
  out["BLOCK_PX"] = rgbavatar::kBlockSide;
  out["FRUSTUM_MARGIN"] = C::kFrustumMargin;
  out["MIN_QUAT_NORM"] = C::kMinQuatNorm;
  out["MAX_AVERAGE_CHANNELS"] = rgbavatar::kMaxChannels;
  const auto byte = [](int k) { return C::kUnfilmed >> (8 * k) & 255; };
  out["UNFILMED_RGBA"] = nb::make_tuple(byte(0), byte(1), byte(2), byte(3));
  return out;
}

}  // namespace

NB_MODULE(_native, m) {
  nb::set_leak_warnings(false);  // a graph may live until the interpreter ends
  m.def("instruction_sets", &rgbavatar::instruction_sets);
  m.def("constants", &constants);
  nb::class_<Gaussians>(m, "Gaussians")
      .def(nb::init<Input, Input, Input, Input, Input, std::optional<Input>>(),
           "means"_a.noconvert(), "quats_wxyz"_a.noconvert(), "scales"_a.noconvert(),
           "opacities"_a.noconvert(), "colors"_a.noconvert(),
           "screen_offset"_a.noconvert().none() = nb::none());
  using Release = nb::call_guard<nb::gil_scoped_release>;
  m.def("mean_similarity", &mean_similarity, "image"_a.noconvert(), "target"_a.noconvert(),
        "window"_a.noconvert(), "c1"_a, "c2"_a, "gradient"_a.noconvert().none(), "threads"_a,
        "instruction_set"_a, Release());
  nb::class_<Drawing<rgbavatar::Rendering>> drawing(m, "Drawing");
  Drawing<rgbavatar::Rendering>::bind(drawing);
  nb::class_<Drawing<rgbavatar::MorphedRendering>> morphed_drawing(m, "MorphedDrawing");
  Drawing<rgbavatar::MorphedRendering>::bind(morphed_drawing);
  nb::class_<Session, Drawing<rgbavatar::Rendering>>(m, "Session")
      .def(nb::init<const Gaussians&, const Input&, const Input&, const Input&, int, int, int, int,
                    const std::string&>(),
           "gaussians"_a, "world_to_camera"_a.noconvert(), "focal_px"_a.noconvert(),
           "principal_point_px"_a.noconvert(), "batch"_a, "width"_a, "height"_a, "threads"_a,
           "instruction_set"_a, Release())
      .def("backward", &Session::backward, "gaussians"_a, "background"_a.noconvert(),
           "image_grad"_a.noconvert().none(), "alpha_grad"_a.noconvert().none(), "threads"_a,
           "means"_a.noconvert(), "quats_wxyz"_a.noconvert(), "scales"_a.noconvert(),
           "opacities"_a.noconvert(), "colors"_a.noconvert(),
           "screen_offset"_a.noconvert().none() = nb::none(), Release());
  nb::class_<Morphed>(m, "Morphed")
      .def("__init__",
           [](Morphed* self, Input position, Input rotation, Input color, Input log_scale,
              Input opacity_logit, std::optional<Input> basis_position,
              std::optional<Input> basis_rotation, std::optional<Input> basis_color,
              Input barycentric, Input edges_to_frame, std::optional<Input> rest_length,
              Indices triangle_vertices, Indices triangle_of, int variant) {
             new (self) Morphed{position,       rotation,    color,          log_scale,
                                opacity_logit,  basis_position, basis_rotation, basis_color,
                                barycentric,    edges_to_frame, rest_length,
                                triangle_vertices, triangle_of, variant};
           },
           "position"_a.noconvert(), "rotation_wxyz"_a.noconvert(), "color_feature"_a.noconvert(),
           "log_scale"_a.noconvert(), "opacity_logit"_a.noconvert(),
           "basis_position"_a.noconvert().none(), "basis_rotation_wxyz"_a.noconvert().none(),
           "basis_color_feature"_a.noconvert().none(), "barycentric"_a.noconvert(),
           "edges_to_frame"_a.noconvert(), "rest_length"_a.noconvert().none(),
           "triangle_vertices"_a.noconvert(), "triangle_of"_a.noconvert(), "variant"_a);
  nb::class_<MorphedSession, Drawing<rgbavatar::MorphedRendering>>(m, "MorphedSession")
      .def(nb::init<const Morphed&, const Input&, const Input&, const Input&, const Input&,
                    const Input&, int, int, int, const std::string&>(),
           "blended"_a, "weights"_a.noconvert(), "vertices"_a.noconvert(),
           "world_to_camera"_a.noconvert(), "focal_px"_a.noconvert(),
           "principal_point_px"_a.noconvert(), "width"_a, "height"_a, "threads"_a,
           "instruction_set"_a, Release())
      .def("forward_loss", &MorphedSession::forward_loss, "images_rgba"_a.noconvert(),
           "background"_a.noconvert(), "known"_a.noconvert().none() = nb::none(),
           "sums"_a.noconvert().none() = nb::none(), "threshold"_a = 0.0f,
           "sight_images"_a = 0, "over_background"_a = false, Release())
      .def("backward_adam", &MorphedSession::backward_adam, "groups"_a, "weight_gradient"_a.noconvert(),
           "vertex_gradient"_a.noconvert().none() = nb::none(), Release());
  nb::class_<Packed>(m, "Packed")
      .def(nb::init<const Morphed&, const Input&, const Input&, int>(), "blended"_a,
           "weights"_a.noconvert(), "vertices"_a.noconvert(), "threads"_a, Release())
      .def_prop_ro("count", &Packed::count)
      .def_prop_ro("bytes", &Packed::bytes);
  nb::class_<Drawing<rgbavatar::PackedRendering>> packed_drawing(m, "PackedDrawing");
  Drawing<rgbavatar::PackedRendering>::bind_draw(packed_drawing);
  nb::class_<PackedSession, Drawing<rgbavatar::PackedRendering>>(m, "PackedSession")
      .def(nb::init<const Packed&, const Input&, const Input&, const Input&, const Input&,
                    const Input&, int, int, int, const std::string&>(),
           "packed"_a, "weights"_a.noconvert(), "vertices"_a.noconvert(),
           "world_to_camera"_a.noconvert(), "focal_px"_a.noconvert(),
           "principal_point_px"_a.noconvert(), "width"_a, "height"_a, "threads"_a,
           "instruction_set"_a, Release());
  bind_harmonics(m);
  bind_posing(m);
}
