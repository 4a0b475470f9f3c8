// Harmonics as Python sees them; shapes have been checked by kernels/harmonics.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <algorithm>

#include "harmonics_layout.h"
#include "raster.h"
#include "team.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Input = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

constexpr int kAtATime = 512;

// Coefficients [1 or B, N, C, 3] and directions [B, N, 3].
rgbavatar::HarmonicScene scene(const Input& coefficients, const Input& directions) {
  const int count = int(coefficients.shape(1)), harmonics = int(coefficients.shape(2));
  return {int(directions.shape(0)),
          count,
          harmonics,
          coefficients.data(),
          coefficients.shape(0) == 1 ? 0 : int64_t(count) * harmonics * 3,
          directions.data()};
}

template <class Work>
void by_parts(int count, int threads, const Work& work) {
  rgbavatar::Team team(threads);
  team.run((count + kAtATime - 1) / kAtATime, [&](int64_t part, int) {
    const int begin = int(part) * kAtATime;
    work(begin, std::min(begin + kAtATime, count));
  });
}

void harmonic_colors(const Input& coefficients, const Input& directions, const Output& colors,
                     int threads, const std::string& instruction_set) {
  const rgbavatar::Kernels* kernels = rgbavatar::kernels_for(instruction_set);
  const rgbavatar::HarmonicScene s = scene(coefficients, directions);
  by_parts(s.count, threads,
           [&](int begin, int end) { kernels->harmonic_colors(s, begin, end, colors.data()); });
}

void harmonic_gradient(const Input& coefficients, const Input& directions,
                       const Input& color_gradient, const Output& coefficient_gradient,
                       const Output& direction_gradient, int threads,
                       const std::string& instruction_set) {
  const rgbavatar::Kernels* kernels = rgbavatar::kernels_for(instruction_set);
  const rgbavatar::HarmonicScene s = scene(coefficients, directions);
  by_parts(s.count, threads, [&](int begin, int end) {
    kernels->harmonic_gradient(s, begin, end, color_gradient.data(), coefficient_gradient.data(),
                               direction_gradient.data());
  });
}

}  // namespace

void bind_harmonics(nb::module_& m) {
  using Release = nb::call_guard<nb::gil_scoped_release>;
  m.def("harmonic_colors", &harmonic_colors, "coefficients"_a.noconvert(),
        "directions"_a.noconvert(), "colors"_a.noconvert(), "threads"_a, "instruction_set"_a,
        Release());
  m.def("harmonic_gradient", &harmonic_gradient, "coefficients"_a.noconvert(),
        "directions"_a.noconvert(), "color_gradient"_a.noconvert(),
        "coefficient_gradient"_a.noconvert(), "direction_gradient"_a.noconvert(), "threads"_a,
        "instruction_set"_a, Release());
}
