// Structural similarity (SSIM) of pictures with its gradient.
#pragma once

#include <string>
#include <vector>

#include "similarity_layout.h"

namespace rgbavatar {

// The mean of each of `count` pairs of pictures over windows that lie within them, and, unless
// `gradient` is null, its gradient by the first, [count, height, width]. `scene` is the first pair.
std::vector<double> mean_similarity(SimilarityScene scene, int count, float* gradient, int threads,
                                    const std::string& instruction_set);

}  // namespace rgbavatar
