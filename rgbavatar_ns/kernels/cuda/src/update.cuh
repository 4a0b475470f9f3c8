// Gradients straight into Adam, and the gradient of the weights that the bases were summed with.
//
// A thread has a column of a parameter and walks the bases, whose next values are on their way while
// one is updated. The gradient of the weights is a product, [B, columns] by [columns, K]: each warp
// takes its 32 columns of eight bases at a time in shared memory, a lane for one of the bases and a
// quarter of the images, so that nothing is summed over lanes. The block adds up its warps.

constexpr int kUpdatedTogether = 5;
constexpr int kHeldImages = 12;  // whose gradients stay in registers
constexpr int kBasesAtOnce = 8;
constexpr int kPaddedWarp = 36;  // a row of 32 columns: rows of sixteen bytes, in other banks

struct UpdateTile {
  alignas(16) float gradient[kHeldImages][kPaddedWarp];
  alignas(16) float basis[kBasesAtOnce][kPaddedWarp];
  float product[kHeldImages * kBasesAtOnce];
};

RGBAVATAR_FUNCTION float add_product(float sum, const Four& a, const Four& b) {
  return sum + a.x * b.x + a.y * b.y + (a.z * b.z + a.w * b.w);
}

// A value with Adam's moments.
struct Moving {
  float value, first, second;
};

RGBAVATAR_FUNCTION AdamStep adam_step(const float* numbers) {
  return {numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]};
}

// The compiler cannot see through a choice of pointers that all of them are to global memory.
template <class T>
RGBAVATAR_FUNCTION void is_global(T* pointer) {
#if defined(__CUDA_ARCH__)
  if (pointer) __builtin_assume(__isGlobal(pointer));
#endif
}

RGBAVATAR_FUNCTION Columns columns_of_block(const UpdateArguments& a) {
  const int which = int(blockIdx.y);
  const Columns c = which == 0   ? a.columns0
                    : which == 1 ? a.columns1
                    : which == 2 ? a.columns2
                    : which == 3 ? a.columns3
                                 : a.columns4;
  is_global(c.gradient), is_global(c.numbers), is_global(c.weight_sums);
  is_global(c.base), is_global(c.base_first), is_global(c.base_second);
  is_global(c.basis), is_global(c.basis_first), is_global(c.basis_second);
  return c;
}

// The warp's part of the product, kHeldImages by kBasesAtOnce.
RGBAVATAR_FUNCTION void multiply_tile(UpdateTile& tile, int images) {
  const int lane = int(threadIdx.x) & 31, k = lane & 7, b = lane >> 3;
  float own[kHeldImages / 4] = {};
#pragma unroll
  for (int column = 0; column < 32; column += 4) {
    const Four value = four_at(&tile.basis[k][column]);
#pragma unroll
    for (int i = 0; i < kHeldImages / 4; ++i)
      if (4 * i < images)
        own[i] = add_product(own[i], value, four_at(&tile.gradient[4 * i + b][column]));
  }
#pragma unroll
  for (int i = 0; i < kHeldImages / 4; ++i) tile.product[(4 * i + b) * kBasesAtOnce + k] = own[i];
}

RGBAVATAR_KERNEL(update, UpdateArguments, kTileThreads, kUpdateBlocks) {
  RGBAVATAR_DYNAMIC_SHARED(float, weights);  // [K, B], rows padded to fours with zeros
  RGBAVATAR_SHARED UpdateTile tiles[kTileThreads / 32];
  alignas(16) RGBAVATAR_SHARED float numbers[5];  // of the bases
  const Columns c = columns_of_block(a);
  const int column = int(blockIdx.x * blockDim.x + threadIdx.x);
  if (int(blockIdx.x * blockDim.x) >= c.columns) return;
  const int lane = int(threadIdx.x) & 31, warp = int(threadIdx.x) >> 5;
  const int64_t outputs = int64_t(a.batch) * c.bases;
  float* weight_sums = c.weight_sums + blockIdx.x * outputs;
  if (a.status[kOverflow]) {
    for (int i = int(threadIdx.x); i < outputs; i += kTileThreads) weight_sums[i] = 0.0f;
    return;
  }
  const bool exists = column < c.columns;
  const int row = load_weights(a.weights, a.batch, c.bases, weights);
  const auto of_image = [&](int b) {
    return exists && b < a.batch ? c.gradient[int64_t(b) * c.columns + column] : 0.0f;
  };
  float held[kHeldImages], sum = 0.0f;
#pragma unroll
  for (int b = 0; b < kHeldImages; ++b) held[b] = of_image(b), sum += held[b];
  for (int b = kHeldImages; b < a.batch; ++b) sum += of_image(b);
  if (exists && c.base_first) {
    Moving now = {c.base[column], c.base_first[column], c.base_second[column]};
    adam_update(sum, adam_step(c.numbers), now.value, now.first, now.second);
    c.base[column] = now.value, c.base_first[column] = now.first;
    c.base_second[column] = now.second;
  }
  if (!c.bases) return;
  const bool updates = exists && c.basis_first;
  if (threadIdx.x < 5 && c.basis_first) numbers[threadIdx.x] = c.numbers[5 + threadIdx.x];
  const auto moving_at = [&](int k) {
    const int64_t place = int64_t(k) * c.columns + column;
    Moving out = {};
    if (exists) out.value = c.basis[place];
    if (updates) out.first = c.basis_first[place], out.second = c.basis_second[place];
    return out;
  };
  UpdateTile& tile = tiles[warp];
#pragma unroll
  for (int b = 0; b < kHeldImages; ++b) tile.gradient[b][lane] = held[b];
  Moving next = moving_at(0);
  __syncthreads();
  for (int first = 0; first < c.bases; first += kBasesAtOnce) {
    const int number = c.bases - first < kBasesAtOnce ? c.bases - first : kBasesAtOnce;
    for (int k = first; k < first + number; ++k) {
      Moving now = next;
      if (k + 1 < c.bases) next = moving_at(k + 1);
      tile.basis[k - first][lane] = now.value;
      if (!updates) continue;
      float gradient = 0.0f;
#pragma unroll
      for (int b = 0; b < kHeldImages; b += 4)
        if (b < a.batch)
          gradient = add_product(gradient, four_at(weights + k * row + b),
                                 {held[b], held[b + 1], held[b + 2], held[b + 3]});
      for (int b = kHeldImages; b < a.batch; ++b) gradient += weights[k * row + b] * of_image(b);
      adam_update(gradient, adam_step(numbers), now.value, now.first, now.second);
      const int64_t place = int64_t(k) * c.columns + column;
      c.basis[place] = now.value, c.basis_first[place] = now.first;
      c.basis_second[place] = now.second;
    }
    for (int image = 0; image < a.batch; image += kHeldImages) {
      const int images = a.batch - image < kHeldImages ? a.batch - image : kHeldImages;
      if (a.batch > kHeldImages) {
        __syncwarp();
#pragma unroll 1
        for (int b = 0; b < kHeldImages; ++b) tile.gradient[b][lane] = of_image(image + b);
      }
      __syncwarp();
      multiply_tile(tile, images);
      __syncthreads();
      for (int i = int(threadIdx.x); i < images * kBasesAtOnce; i += kTileThreads) {
        const int b = i / kBasesAtOnce, k = i % kBasesAtOnce;
        if (k >= number) continue;
        float all = 0.0f;
        for (UpdateTile& of_warp : tiles) all += of_warp.product[i];
        weight_sums[int64_t(image + b) * c.bases + first + k] = all;
      }
      __syncthreads();
    }
  }
}
