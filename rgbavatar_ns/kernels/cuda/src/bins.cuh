// Tiles' lists of Gaussians: where each begins, what is in it, front to back.

// Exclusive sums of the tiles' counts by one block, and whether they fit.
constexpr int kScanThreads = 1024, kScanEach = 8;
RGBAVATAR_KERNEL(scan, ScanArguments, kScanThreads) {
  RGBAVATAR_SHARED uint32_t warp_total[32];
  const int count = a.frame.batch * a.frame.tiles_x * a.frame.tiles_y;
  const int thread = int(threadIdx.x), lane = thread & 31, warp = thread >> 5;
  uint32_t before = 0;
  for (int base = 0; base < count; base += kScanThreads * kScanEach) {
    const int first = base + thread * kScanEach;
    uint32_t mine[kScanEach], sum = 0;
    for (int i = 0; i < kScanEach; ++i) {
      mine[i] = first + i < count ? a.bins.tile_count[first + i] : 0u;
      sum += mine[i];
    }
    uint32_t inclusive = sum;
    for (int step = 1; step < 32; step *= 2) {
      const uint32_t below = __shfl_up_sync(kWholeWarp, inclusive, step);
      if (lane >= step) inclusive += below;
    }
    if (lane == 31) warp_total[warp] = inclusive;
    __syncthreads();
    uint32_t start = before + inclusive - sum, all = 0;
    for (int i = 0; i < 32; ++i) {
      if (i < warp) start += warp_total[i];
      all += warp_total[i];
    }
    for (int i = 0; i < kScanEach; ++i) {
      if (first + i < count) a.bins.tile_start[first + i] = start;
      start += mine[i];
    }
    before += all;
    __syncthreads();
  }
  if (thread != 0) return;
  a.bins.tile_start[count] = before;
  a.bins.status[kEntriesNeeded] = before;
  const uint32_t capacity = uint32_t(a.bins.capacity);
  const bool overflow = before > capacity || a.bins.status[kSlotsNeeded] > capacity;
  a.bins.status[kOverflow] = overflow;
  a.bins.status[kOverflows] += overflow;
}

RGBAVATAR_FUNCTION bool overflowed(const Bins& bins) { return bins.status[kOverflow] != 0; }

// Puts every Gaussian into the lists of its tiles, in any order.
RGBAVATAR_KERNEL(scatter, ScatterArguments, kTileThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  if (gaussian >= a.frame.count) return;
  const Splat s = splats_of(a.frame, a.bins, image)[gaussian];
  if (!s.drawn()) return;
  const uint64_t key = uint64_t(__float_as_uint(s.depth)) << 32 | uint32_t(gaussian);
  const int64_t first = int64_t(image) * a.frame.tiles_x * a.frame.tiles_y;
  for (int ty = s.first_y(); ty <= s.last_y(); ++ty)
    for (int tx = s.first_x(); tx <= s.last_x(); ++tx) {
      if (!touches_tile(s, a.frame, tx, ty)) continue;
      const int64_t tile = first + ty * a.frame.tiles_x + tx;
      const uint32_t left = atomicSub(a.bins.tile_count + tile, 1u) - 1u;
      const uint64_t place = uint64_t(a.bins.tile_start[tile]) + left;
      if (place < uint64_t(a.bins.capacity)) a.bins.entries[place] = key;
    }
}

RGBAVATAR_FUNCTION void sort_pair(uint64_t* keys, int low, int high, int count) {
  if (high >= count) return;  // what would stand there is larger than any key
  const uint64_t a = keys[low], b = keys[high];
  if (a <= b) return;
  keys[low] = b, keys[high] = a;
}

// Batcher's bitonic sort whose merges begin with a mirrored step, so that every comparison puts the
// smaller key first and lists of any length are sorted.
RGBAVATAR_FUNCTION void sort_keys(uint64_t* keys, int count) {
  int padded = 1;
  while (padded < count) padded *= 2;
  for (int run = 2; run <= padded; run *= 2) {
    for (int i = int(threadIdx.x); i < padded / 2; i += int(blockDim.x)) {
      const int half = run / 2, within = i % half, first = i / half * run;
      sort_pair(keys, first + within, first + run - 1 - within, count);
    }
    __syncthreads();
    for (int half = run / 4; half > 0; half /= 2) {
      for (int i = int(threadIdx.x); i < padded / 2; i += int(blockDim.x)) {
        const int low = i / half * 2 * half + i % half;
        sort_pair(keys, low, low + half, count);
      }
      __syncthreads();
    }
  }
}

// One block a tile. Lists that do not fit shared memory are sorted where they stand.
constexpr int kSharedKeys = 2048;
RGBAVATAR_KERNEL(sort, SortArguments, kTileThreads) {
  RGBAVATAR_SHARED uint64_t keys[kSharedKeys];
  if (overflowed(a.bins)) return;
  const int64_t tile = int64_t(blockIdx.y) * gridDim.x + blockIdx.x;
  const uint32_t start = a.bins.tile_start[tile];
  const int count = int(a.bins.tile_start[tile + 1] - start);
  uint64_t* list = a.bins.entries + start;
  if (count < 2) return;
  if (count > kSharedKeys) return sort_keys(list, count);
  for (int i = int(threadIdx.x); i < count; i += int(blockDim.x)) keys[i] = list[i];
  __syncthreads();
  sort_keys(keys, count);
  for (int i = int(threadIdx.x); i < count; i += int(blockDim.x)) list[i] = keys[i];
}
