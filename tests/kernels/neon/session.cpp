// One call of the rasterizer for a process of another architecture: inputs from a file, outputs into
// another. Arrays are given as the first dimension, the number of floats, and these; 0 and 0 is none.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "raster.h"

namespace {

struct Array {
  int32_t rows = 0, floats = 0;
  std::vector<float> data;
  const float* pointer() const { return rows ? data.data() : nullptr; }
  rgbavatar::Attribute attribute() const { return {pointer(), rows > 1 ? floats / rows : 0}; }
};

void must(bool good) {
  if (!good) std::exit(3);
}

Array read_array(std::FILE* from) {
  Array a;
  must(std::fread(&a.rows, 4, 1, from) == 1 && std::fread(&a.floats, 4, 1, from) == 1);
  a.data.resize(a.floats);
  must(std::fread(a.data.data(), 4, a.data.size(), from) == a.data.size());
  return a;
}

}  // namespace

int main(int, char** arguments) {
  const std::string call = arguments[1];
  std::FILE* from = std::fopen(arguments[2], "rb");
  std::FILE* to = std::fopen(arguments[3], "wb");
  int32_t sizes[5];  // batch, Gaussians, width, height, threads
  must(from && to && std::fread(sizes, sizeof sizes, 1, from) == 1);
  const auto [batch, count, width, height, threads] = sizes;
  const auto next = [&] { return read_array(from); };
  const Array means = next(), quats = next(), scales = next(), opacities = next(), colors = next();
  const Array offset = next(), world_to_camera = next(), focal_px = next(), principal_px = next();
  const Array first = next(), second = next(), third = next();
  const rgbavatar::Scene scene = {batch,
                                  count,
                                  width,
                                  height,
                                  means.attribute(),
                                  quats.attribute(),
                                  scales.attribute(),
                                  opacities.attribute(),
                                  colors.attribute(),
                                  offset.attribute()};
  rgbavatar::Rendering rendering(scene,
                                 {world_to_camera.pointer(), focal_px.pointer(),
                                  principal_px.pointer(), focal_px.rows},
                                 "generic", threads);
  std::vector<std::vector<float>> out;
  const auto filled = [&](size_t floats) {
    out.emplace_back(floats);
    return out.back().data();
  };
  out.reserve(6);
  const size_t pixels = size_t(batch) * width * height, gaussians = size_t(batch) * count;
  if (call == "draw") {  // background
    float *image = filled(pixels * 3), *alpha = filled(pixels), *depth = filled(pixels);
    rendering.draw(first.attribute(), 0, batch, image, alpha, depth, threads);
  } else if (call == "average") {  // images
    const int channels = first.rows ? first.floats / (first.rows * width * height) : 0;
    float *sum = filled(gaussians * channels), *weight = filled(gaussians);
    rendering.average(first.attribute(), channels, sum, weight, filled(gaussians), threads);
  } else {  // background, gradients of image and alpha
    std::vector<float*> gradient;
    for (const Array* a : {&means, &quats, &scales, &opacities, &colors, &offset})
      gradient.push_back(a->rows ? filled(a->floats) : nullptr);
    rendering.backward(scene, first.attribute(), second.pointer(), third.pointer(),
                       {gradient[0], gradient[1], gradient[2], gradient[3], gradient[4], gradient[5]},
                       threads);
  }
  for (const std::vector<float>& floats : out)
    must(std::fwrite(floats.data(), 4, floats.size(), to) == floats.size());
  must(std::fclose(to) == 0);
}
