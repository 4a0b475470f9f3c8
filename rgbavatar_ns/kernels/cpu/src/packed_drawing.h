// Morphed Gaussians packed once for many pictures, and the drawing of one.
#pragma once

#include "packed_layout.h"
#include "raster.h"

namespace rgbavatar {

// A copy of a scene's Gaussians in `packed_layout.h`'s form, without those too transparent for any
// picture, and those that hold a number which is not finite. Bases are in units of their own, a
// power of two each, so that the largest number of each is near the half's largest.
class PackedGaussians {
 public:
  PackedGaussians(const MorphedScene& scene, int threads);

  size_t count() const { return chosen_.size(); }
  size_t bytes() const;
  int padded_count() const { return blocks_ * kPackedLanes; }

  // What is drawn with the weights [K]; `weights` gets them over the bases' units.
  PackedScene scene(const MorphedScene& scene, const float* frames,
                    std::vector<float>& weights) const;

 private:
  void choose(const MorphedScene& scene);
  void measure(const MorphedScene& scene, int kind, int k);
  void pack_block(const MorphedScene& scene, int block);

  int blocks_ = 0, bases_ = 0;
  std::vector<int32_t> chosen_;
  std::vector<float> unit_;  // [kinds, K]
  std::vector<char> drawn_;  // [N]
  Buffer<float> base_;
  Buffer<uint16_t> basis_;
  Buffer<int32_t> triangle_;
};

// One picture of packed Gaussians; like a Rendering whose batch is 1, for drawing alone.
class PackedRendering : public Rendering {
 public:
  // The scene tells weights, vertices and mesh.
  PackedRendering(const PackedGaussians& gaussians, MorphedScene scene, const Cameras& cameras,
                  const std::string& instruction_set, int threads);

  // As a Rendering's.
  void draw(const Attribute& background, int first, int sets, float* image, float* alpha,
            float* depth, int threads);
};

}  // namespace rgbavatar
