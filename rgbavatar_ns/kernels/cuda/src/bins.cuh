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
  // Every entry has taken a slot: where the sum of the entries wraps, the slots are too many.
  const uint64_t slots = *reinterpret_cast<const uint64_t*>(a.bins.status + kSlotsTaken);
  const bool overflow = slots > uint64_t(a.bins.capacity);
  a.bins.status[kEntriesNeeded] = uint32_t(slots < before ? slots : before);
  a.bins.status[kSlotsNeeded] = uint32_t(slots < uint64_t(kMostEntries) ? slots : kMostEntries);
  a.bins.status[kOverflow] = overflow;
  a.bins.status[kOverflows] += overflow;
}

RGBAVATAR_FUNCTION bool overflowed(const Bins& bins) { return bins.status[kOverflow] != 0; }

// Puts every Gaussian into the lists of its tiles, in any order.
RGBAVATAR_KERNEL(scatter, ScatterArguments, kTileThreads) {
  const int gaussian = int(blockIdx.x * blockDim.x + threadIdx.x), image = int(blockIdx.y);
  const int64_t first = int64_t(image) * a.frame.tiles_x * a.frame.tiles_y;
  if (overflowed(a.bins)) return;
  const Splat* splats = splats_of(a.frame, a.bins, image);
  for_each_tile(a.frame, splats, gaussian, splat_at(splats, a.frame, gaussian),
                [&](int which, const Splat& s, int x, int y) {
                  const uint64_t depth = __float_as_uint(s.depth);
                  const int64_t tile = first + y * a.frame.tiles_x + x;
                  const uint32_t left = atomicSub(a.bins.tile_count + tile, 1u) - 1u;
                  a.bins.entries[uint64_t(a.bins.tile_start[tile]) + left] =
                      depth << 32 | uint32_t(which);
                });
}

// ---- Sorting: Batcher's bitonic network. Its merges begin with a mirrored step, so that every
// comparison puts the smaller key first and lists of any length are sorted; what would stand behind
// a list's end is larger than any key.

constexpr uint64_t kNoKey = ~uint64_t(0);

RGBAVATAR_FUNCTION void sort_pair(uint64_t* keys, int low, int high, int count) {
  if (high >= count) return;
  const uint64_t a = keys[low], b = keys[high];
  if (a <= b) return;
  keys[low] = b, keys[high] = a;
}

// The first step of the merges into runs of 2^log_run keys.
RGBAVATAR_FUNCTION void mirrored_step(uint64_t* keys, int count, int pairs, int log_run) {
  const int log_half = log_run - 1, last = (1 << log_run) - 1;
  for (int i = int(threadIdx.x); i < pairs; i += int(blockDim.x)) {
    const int within = i & ((1 << log_half) - 1), first = i >> log_half << log_run;
    sort_pair(keys, first + within, first + last - within, count);
  }
  __syncthreads();
}

// The step with partners 2^log_half apart.
RGBAVATAR_FUNCTION void half_step(uint64_t* keys, int count, int pairs, int log_half) {
  for (int i = int(threadIdx.x); i < pairs; i += int(blockDim.x)) {
    const int low = (i >> log_half << (log_half + 1)) + (i & ((1 << log_half) - 1));
    sort_pair(keys, low, low + (1 << log_half), count);
  }
  __syncthreads();
}

// The thread's key after it met that of the lane whose number differs by `mask`.
RGBAVATAR_FUNCTION uint64_t meet_key(uint64_t mine, int mask, bool keeps_small) {
  const uint64_t other =
      __shfl_xor_sync(kWholeWarp, (unsigned long long)(mine), mask);
  return (mine < other) == keeps_small ? mine : other;
}

// The steps with partners less than 32 apart, in registers: the last of a merge, or all the merges
// into runs of 32.
template <bool kWhole>
RGBAVATAR_FUNCTION void steps_of_warps(uint64_t* keys, int count) {
  const int lane = int(threadIdx.x) & 31;
  for (int i = int(threadIdx.x); (i & ~31) < count; i += int(blockDim.x)) {
    uint64_t key = i < count ? keys[i] : kNoKey;
#pragma unroll
    for (int run = kWhole ? 2 : 32; run <= 32; run *= 2) {
      if (kWhole) key = meet_key(key, run - 1, !(lane & run / 2));
#pragma unroll
      for (int half = kWhole ? run / 4 : 16; half > 0; half /= 2)
        key = meet_key(key, half, !(lane & half));
    }
    if (i < count) keys[i] = key;
  }
  __syncthreads();
}

// The steps of a merge with partners 2^log_half apart and less; both bounds count pairs.
RGBAVATAR_FUNCTION void half_steps(uint64_t* keys, int count, int pairs, int log_half) {
  for (; log_half >= 5; --log_half) half_step(keys, count, pairs, log_half);
  steps_of_warps<false>(keys, count);
}

// Half the smallest power of two, 32 or more, that holds so many keys.
RGBAVATAR_FUNCTION int pairs_of(int count) {
  int pairs = 16;
  while (2 * pairs < count) pairs *= 2;
  return pairs;
}

RGBAVATAR_FUNCTION void sort_keys(uint64_t* keys, int count) {
  const int pairs = pairs_of(count);
  steps_of_warps<true>(keys, count);
  for (int log_run = 6; 1 << log_run <= 2 * pairs; ++log_run) {
    mirrored_step(keys, count, pairs, log_run);
    half_steps(keys, count, pairs, log_run - 2);
  }
}

// A list's parts of at most kSharedKeys, one after another in shared memory while `work` is done on
// them.
constexpr int kLogSharedKeys = 11, kSharedKeys = 1 << kLogSharedKeys;
template <class Work>
RGBAVATAR_FUNCTION void for_each_part(uint64_t* list, int count, uint64_t* keys,
                                      const Work& work) {
  for (int first = 0; first < count; first += kSharedKeys) {
    uint64_t* const part = list + first;
    const int length = count - first < kSharedKeys ? count - first : kSharedKeys;
    for (int i = int(threadIdx.x); i < length; i += int(blockDim.x)) keys[i] = part[i];
    __syncthreads();
    work(length);
    for (int i = int(threadIdx.x); i < length; i += int(blockDim.x)) part[i] = keys[i];
    __syncthreads();
  }
}

// One block a tile. Of lists that do not fit shared memory only the steps with far partners are
// taken where they stand: one pass of global memory for twice as many keys, three for four times.
RGBAVATAR_KERNEL(sort, SortArguments, kTileThreads) {
  RGBAVATAR_SHARED uint64_t keys[kSharedKeys];
  if (overflowed(a.bins)) return;
  const int64_t tile = int64_t(blockIdx.y) * gridDim.x + blockIdx.x;
  const uint32_t start = a.bins.tile_start[tile];
  const int count = int(a.bins.tile_start[tile + 1] - start);
  uint64_t* list = a.bins.entries + start;
  if (count < 2) return;
  for_each_part(list, count, keys, [&](int part) { sort_keys(keys, part); });
  const int pairs = pairs_of(count);
  for (int log_run = kLogSharedKeys + 1; 1 << log_run <= 2 * pairs; ++log_run) {
    mirrored_step(list, count, pairs, log_run);
    for (int log_half = log_run - 2; log_half >= kLogSharedKeys; --log_half)
      half_step(list, count, pairs, log_half);
    for_each_part(list, count, keys, [&](int part) {
      half_steps(keys, part, kSharedKeys / 2, kLogSharedKeys - 1);
    });
  }
}
