// Packing, and the driver for packed Gaussians.
#include "packed_drawing.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "team.h"

namespace rgbavatar {

namespace {

constexpr int kFrameChunk = 512;
constexpr float kMinAlpha = 1.0f / 255.0f;
constexpr float kLeastUnit = 1e-37f;  // below, floats lose digits; too little to be seen

bool is_finite(float x) { return x * 0.0f == 0.0f; }

// To the nearest half, ties to even; |x| < 65504.
uint16_t half_of(float x) {
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  const uint32_t sign = bits >> 16 & 0x8000u;
  bits &= 0x7fffffffu;
  if (bits < 0x38800000u) {  // subnormal: the half's smallest step is that of floats from 1/2 on
    float size;
    std::memcpy(&size, &bits, sizeof size);
    size += 0.5f;
    std::memcpy(&bits, &size, sizeof bits);
    return uint16_t(sign | (bits - 0x3f000000u));
  }
  return uint16_t(sign | (bits + 0xfffu + (bits >> 13 & 1) - (112u << 23)) >> 13);
}

// As the loops have it: within what a float holds.
float exponential(float x) {
  const float p = x * 1.4426950408889634f;
  return std::exp2(p > -125.0f ? std::min(p, 125.0f) : -125.0f);
}

float opacity_of(const MorphedScene& scene, int64_t i) {
  const float logit = scene.opacity_logit[i];
  return logit == logit ? 1.0f / (1.0f + exponential(-logit)) : 0.0f;
}

}  // namespace

PackedGaussians::PackedGaussians(const MorphedScene& scene, int threads) : bases_(scene.bases) {
  Team team(threads);
  drawn_.assign(scene.count, 1);
  half_unit_.assign(bases_, 1.0f);
  choose(scene);
  for (int kind = 0; kind < kMorphedKinds; ++kind)
    for (int k = 0; k < bases_; ++k) {
      const float size = largest(scene, kind, k);
      if (kind != kPositionKind || size == 0.0f) continue;
      int exponent;
      std::frexp(size, &exponent);  // size < 2^exponent, which becomes 2^15
      half_unit_[k] = std::ldexp(1.0f, std::min(std::max(exponent - 15, -100), 100));
    }
  for (int i = 0; i < scene.count; ++i)
    if (drawn_[i]) chosen_.push_back(i);
  blocks_ = int((chosen_.size() + kPackedLanes - 1) / kPackedLanes);
  const size_t lanes = size_t(blocks_) * kPackedLanes;
  base_.reserve(lanes * kPackedColumns);
  halves_.reserve(lanes * bases_ * kPackedHalves);
  words_.reserve(lanes * bases_ * kPackedWords);
  word_unit_.reserve(size_t(blocks_) * bases_ * kPackedWords);
  triangle_.reserve(lanes);
  team.run(blocks_, [&](int64_t block, int) { pack_block(scene, int(block)); });
}

size_t PackedGaussians::bytes() const {
  const size_t basis = kPackedHalves * sizeof(uint16_t) + kPackedWords * sizeof(int32_t);
  const size_t lane = kPackedColumns * sizeof(float) + sizeof(int32_t) + bases_ * basis;
  return size_t(blocks_) * (kPackedLanes * lane + bases_ * kPackedWords * sizeof(float));
}

// Opacities change with nothing, so that those below the cut show in no picture. The loops make
// theirs with an error of their own, and have the last word near the cut.
void PackedGaussians::choose(const MorphedScene& scene) {
  for (int i = 0; i < scene.count; ++i) {
    float all = 0.0f;
    for (int kind = 0; kind < kMorphedKinds; ++kind)
      for (int c = 0; c < kMorphedWidth[kind]; ++c)
        all += scene.base[kind][int64_t(i) * kMorphedWidth[kind] + c] * 0.0f;
    const float* size = scene.log_scale + int64_t(i) * 3;
    const bool is_sized = size[0] == size[0] && size[1] == size[1] && size[2] == size[2];
    drawn_[i] = opacity_of(scene, i) >= kMinAlpha * 0.9999f && is_finite(all) && is_sized;
  }
}

// A basis' largest number; the Gaussians that it makes invisible are not drawn.
float PackedGaussians::largest(const MorphedScene& scene, int kind, int k) {
  const int width = kMorphedWidth[kind];
  const float* basis = scene.basis[kind] + int64_t(k) * scene.count * width;
  float largest = 0.0f;
  for (int i = 0; i < scene.count; ++i)
    for (int c = 0; drawn_[i] && c < width; ++c) {
      const float size = std::fabs(basis[int64_t(i) * width + c]);
      if (!is_finite(size))
        drawn_[i] = 0;
      else
        largest = std::max(largest, size);
    }
  return largest;
}

int64_t PackedGaussians::of_lane(int block, int lane) const {
  const size_t first = size_t(block) * kPackedLanes;
  return chosen_[first + lane < chosen_.size() ? first + lane : first];
}

void PackedGaussians::pack_block(const MorphedScene& scene, int block) {
  float* base = base_.data() + size_t(block) * kPackedColumns * kPackedLanes;
  const int first = block * kPackedLanes;
  const int lanes = std::min(int(chosen_.size()) - first, kPackedLanes);
  for (int lane = 0; lane < kPackedLanes; ++lane) {
    const int64_t i = of_lane(block, lane);
    const auto put = [&](int column, float value) { base[column * kPackedLanes + lane] = value; };
    for (int axis = 0; axis < 3; ++axis)
      put(kPackedScale + axis, exponential(scene.log_scale[i * 3 + axis]));
    // What fills the last block is invisible.
    put(kPackedOpacity, lane < lanes ? opacity_of(scene, i) : 0.0f);
    put(kPackedBarycentric, scene.barycentric[i * 3 + 1]);
    put(kPackedBarycentric + 1, scene.barycentric[i * 3 + 2]);
    triangle_[first + lane] = int32_t(scene.triangle_of[i]);
    int column = kPackedPosition;
    for (int kind = 0; kind < kMorphedKinds; ++kind)
      for (int c = 0; c < kMorphedWidth[kind]; ++c)
        put(column++, scene.base[kind][i * kMorphedWidth[kind] + c]);
  }
  pack_halves(scene, block);
  pack_words<kRotationBits>(scene, block, kRotationKind);
  pack_words<kColorBits>(scene, block, kColorKind);
}

void PackedGaussians::pack_halves(const MorphedScene& scene, int block) {
  uint16_t* half = halves_.data() + size_t(block) * bases_ * kPackedHalves * kPackedLanes;
  for (int k = 0; k < bases_; ++k) {
    const float* from = scene.basis[kPositionKind] + int64_t(k) * scene.count * kPackedHalves;
    for (int c = 0; c < kPackedHalves; ++c)
      for (int lane = 0; lane < kPackedLanes; ++lane)
        *half++ = half_of(from[of_lane(block, lane) * kPackedHalves + c] / half_unit_[k]);
  }
}

template <int kBits>
void PackedGaussians::pack_words(const MorphedScene& scene, int block, int kind) {
  constexpr int kLargest = (1 << (kBits - 1)) - 1;
  const int width = kMorphedWidth[kind];
  const size_t row = (size_t(block) * kPackedWords + (kind == kColorKind)) * bases_;
  for (int k = 0; k < bases_; ++k) {
    const float* from = scene.basis[kind] + int64_t(k) * scene.count * width;
    float size = 0.0f;
    for (int lane = 0; lane < kPackedLanes; ++lane)
      for (int c = 0; c < width; ++c)
        size = std::max(size, std::fabs(from[of_lane(block, lane) * width + c]));
    const float unit = size / kLargest;
    word_unit_[row + k] = unit;
    for (int lane = 0; lane < kPackedLanes; ++lane) {
      uint32_t word = 0;
      for (int c = 0; unit > kLeastUnit && c < width; ++c) {
        const long number = std::lrint(from[of_lane(block, lane) * width + c] / unit);
        word |= (uint32_t(number) & ((1u << kBits) - 1)) << (kBits * c);
      }
      words_[(row + k) * kPackedLanes + lane] = int32_t(word);
    }
  }
}

PackedScene PackedGaussians::scene(const MorphedScene& scene, const float* frames,
                                   std::vector<float>& half_weights) const {
  half_weights.resize(bases_);
  for (int k = 0; k < bases_; ++k) half_weights[k] = scene.weights[k] * half_unit_[k];
  return {bases_,         scene.width,          scene.height,    base_.data(),
          halves_.data(), words_.data(),        word_unit_.data(), triangle_.data(),
          half_weights.data(), scene.weights, frames};
}

PackedRendering::PackedRendering(const PackedGaussians& gaussians, MorphedScene scene,
                                 const Cameras& cameras, const std::string& instruction_set,
                                 int threads)
    : Rendering(1, gaussians.padded_count(), scene.width, scene.height, cameras, instruction_set) {
  Team team(threads);
  Workspace& w = *workspace_;
  w.frames.reserve(size_t(scene.triangles) * kFrameFloats);
  scene.frames = w.frames.data();
  make_room_for_entries();
  team.run((scene.triangles + kFrameChunk - 1) / kFrameChunk, [&](int64_t item, int) {
    const int begin = int(item) * kFrameChunk;
    kernels_->fill_frames(scene, 0, begin, std::min(begin + kFrameChunk, scene.triangles));
  });
  std::vector<float> half_weights;
  const PackedScene packed = gaussians.scene(scene, w.frames.data(), half_weights);
  team.run(parts_per_image(), [&](int64_t part, int) {
    const int begin = int(part) * kPart;
    kernels_->project_packed(packed, w.cameras.data(), begin, std::min(begin + kPart, count_),
                             w.projected[0]);
    count_part(0, int(part));
  });
  put_into_tiles(team, false);
}

// Tiles are sorted where they are drawn, in the nearest cache.
void PackedRendering::draw(const Attribute& background, int, int, float* image, float* alpha,
                           float* depth, int threads) {
  Team team(threads);
  make_scratch(team.size());
  workspace_->sort_keys.reserve(size_t(team.size()) * workspace_->most_entries);
  const ForwardOutput out = {background.of(0), image, alpha, depth};
  team.run(tiles_per_image(), [&](int64_t index, int thread) {
    sort_tile(0, int(index), thread);
    kernels_->forward_tile(tile(0, int(index)), out, workspace_->scratch[thread]);
  });
}

}  // namespace rgbavatar
