#include "similarity.h"

#include <algorithm>
#include <memory>
#include <numeric>

#include "raster.h"
#include "team.h"

namespace rgbavatar {

namespace {

// Each band blurs ten rows more than it has; the bands are the same however many threads there are.
constexpr int kBandRows = 32;

int bands(int rows) { return (rows + kBandRows - 1) / kBandRows; }

}  // namespace

std::vector<double> mean_similarity(SimilarityScene scene, int count, float* gradient, int threads,
                                    const std::string& instruction_set) {
  const Kernels* kernels = kernels_for(instruction_set);
  const int64_t pixels = int64_t(scene.width) * scene.height;
  const int lanes = kSimilarityLanes;
  scene.stride = ((scene.width + lanes - 1) / lanes + 2) * lanes;
  std::vector<float> slopes;
  if (gradient) slopes.resize(size_t(scene.rows()) * kSlopes * scene.stride);
  scene.slopes = gradient ? slopes.data() : nullptr;
  Team team(threads);
  const int64_t floats = similarity_scratch(scene.stride);
  const std::unique_ptr<float[]> scratch(new float[team.size() * floats]);
  std::vector<double> means, sums(bands(scene.rows()));
  for (int image = 0; image < count; ++image) {
    team.run(int64_t(sums.size()), [&](int64_t band, int thread) {
      const int begin = int(band) * kBandRows, end = std::min(begin + kBandRows, scene.rows());
      sums[band] = kernels->similarity_rows(scene, begin, end, scratch.get() + thread * floats);
    });
    const double total = std::accumulate(sums.begin(), sums.end(), 0.0);
    means.push_back(total / (double(scene.rows()) * scene.columns()));
    if (gradient)
      team.run(bands(scene.height), [&](int64_t band, int thread) {
        const int begin = int(band) * kBandRows, end = std::min(begin + kBandRows, scene.height);
        kernels->similarity_gradient_rows(scene, begin, end, scratch.get() + thread * floats,
                                          gradient + image * pixels);
      });
    scene.x += pixels;
    scene.y += pixels;
  }
  return means;
}

}  // namespace rgbavatar
