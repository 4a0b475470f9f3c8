// Morphed Gaussians packed once for many pictures, and the drawing of one.
#pragma once

#include "packed_layout.h"
#include "raster.h"

namespace rgbavatar {

// A copy of a scene's Gaussians in `packed_layout.h`'s form, without those too transparent for any
// picture, and those that hold a number which is not finite. Halves are in units of their basis, a
// power of two each, so that the largest is near the largest half; words in units of block and basis.
class PackedGaussians {
 public:
  PackedGaussians(const MorphedScene& scene, int threads);

  size_t count() const { return chosen_.size(); }
  size_t bytes() const;
  int padded_count() const { return blocks_ * kPackedLanes; }

  // What is drawn with the weights [K]; `half_weights` gets them over the halves' units.
  PackedScene scene(const MorphedScene& scene, const float* frames,
                    std::vector<float>& half_weights) const;

 private:
  void choose(const MorphedScene& scene);
  float largest(const MorphedScene& scene, int kind, int k);
  // Of the Gaussian in a lane; the last block is filled with its first.
  int64_t of_lane(int block, int lane) const;
  void pack_block(const MorphedScene& scene, int block);
  void pack_halves(const MorphedScene& scene, int block);
  template <int kBits>
  void pack_words(const MorphedScene& scene, int block, int kind);

  int blocks_ = 0, bases_ = 0;
  std::vector<int32_t> chosen_;
  std::vector<float> half_unit_;  // [K]
  std::vector<char> drawn_;  // [N]
  Buffer<float> base_, word_unit_;
  Buffer<uint16_t> halves_;
  Buffer<int32_t> words_, triangle_;
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
