// The Python module. Arrays arrive through DLPack; shapes have been checked by functional.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>

#include "raster.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

#define RGBAVATAR_FUNCTION static inline
#include "../../shared/gaussian_math.h"

using Input = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

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

  rgbavatar::Scene scene(int batch, int width, int height) const {
    return {batch,
            int(means.shape(1)),
            width,
            height,
            attribute(means),
            attribute(quats),
            attribute(scales),
            attribute(opacities),
            attribute(colors)};
  }
};

// A Rendering with the sizes that its later calls need.
struct Session {
  int batch, width, height, threads;
  rgbavatar::Rendering rendering;

  Session(const Gaussians& gaussians, const Input& world_to_camera, const Input& focal_px,
          const Input& principal_point_px, int batch, int width, int height, int threads,
          const std::string& instruction_set)
      : batch(batch),
        width(width),
        height(height),
        threads(threads),
        rendering(gaussians.scene(batch, width, height),
                  {world_to_camera.data(), focal_px.data(), principal_point_px.data(),
                   int(focal_px.shape(0))},
                  instruction_set, threads) {}

  void draw(const Input& background, const Output& image, const Output& alpha,
            const std::optional<Output>& depth) {
    rendering.draw(attribute(background), image.data(), alpha.data(), pointer(depth), threads);
  }

  void average(const std::optional<Input>& images, const std::optional<Output>& weighted_sum,
               const std::optional<Output>& weight_sum, const Output& max_weight) {
    const rgbavatar::Attribute pixels =
        images ? attribute(*images) : rgbavatar::Attribute{nullptr, 0};
    rendering.average(pixels, images ? int(images->shape(3)) : 0, pointer(weighted_sum),
                      pointer(weight_sum), max_weight.data(), threads);
  }

  void backward(const Gaussians& gaussians, const Input& image, const Input& alpha,
                const std::optional<Input>& image_grad, const std::optional<Input>& alpha_grad,
                const Output& means, const Output& quats, const Output& scales,
                const Output& opacities, const Output& colors, int threads) {
    rendering.backward(
        gaussians.scene(batch, width, height),
        {image.data(), alpha.data(), pointer(image_grad), pointer(alpha_grad)},
        {means.data(), quats.data(), scales.data(), opacities.data(), colors.data()}, threads);
  }
};

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
  return out;
}

}  // namespace

NB_MODULE(_native, m) {
  nb::set_leak_warnings(false);  // a graph may live until the interpreter ends
  m.def("instruction_sets", &rgbavatar::instruction_sets);
  m.def("constants", &constants);
  nb::class_<Gaussians>(m, "Gaussians")
      .def(nb::init<Input, Input, Input, Input, Input>(), "means"_a.noconvert(),
           "quats_wxyz"_a.noconvert(), "scales"_a.noconvert(), "opacities"_a.noconvert(),
           "colors"_a.noconvert());
  using Release = nb::call_guard<nb::gil_scoped_release>;
  nb::class_<Session>(m, "Session")
      .def(nb::init<const Gaussians&, const Input&, const Input&, const Input&, int, int, int, int,
                    const std::string&>(),
           "gaussians"_a, "world_to_camera"_a.noconvert(), "focal_px"_a.noconvert(),
           "principal_point_px"_a.noconvert(), "batch"_a, "width"_a, "height"_a, "threads"_a,
           "instruction_set"_a, Release())
      .def("draw", &Session::draw, "background"_a.noconvert(), "image"_a.noconvert(),
           "alpha"_a.noconvert(), "depth"_a.noconvert().none(), Release())
      .def("average", &Session::average, "images"_a.noconvert().none(),
           "weighted_sum"_a.noconvert().none(), "weight_sum"_a.noconvert().none(),
           "max_weight"_a.noconvert(), Release())
      .def("backward", &Session::backward, "gaussians"_a, "image"_a.noconvert(),
           "alpha"_a.noconvert(), "image_grad"_a.noconvert().none(),
           "alpha_grad"_a.noconvert().none(), "means"_a.noconvert(), "quats_wxyz"_a.noconvert(),
           "scales"_a.noconvert(), "opacities"_a.noconvert(), "colors"_a.noconvert(), "threads"_a,
           Release());
}
