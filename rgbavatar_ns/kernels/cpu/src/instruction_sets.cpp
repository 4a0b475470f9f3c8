// Which copy of the loops runs.
#include <stdexcept>

#if defined(RGBAVATAR_X86)
#include <cpuid.h>
#endif

#include "raster.h"

namespace rgbavatar {

namespace generic {
extern const Kernels kernels;
}
#if defined(RGBAVATAR_X86)
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

namespace {

struct InstructionSet {
  const char* name;
  const Kernels* kernels;
};

#if defined(RGBAVATAR_X86)
// Asked of the processor and of what the system saves of its registers (Intel's manual, volume 1,
// 14.3 and 15.2): __builtin_cpu_supports, which tells the same, knows nothing where zig links.
struct Processor {
  bool avx2 = false, avx512 = false;

  Processor() {
    unsigned a, b, c, d, saved, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE)) return;
    const bool fma = (c & bit_FMA) && (c & bit_F16C);
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return;
    const unsigned wide = bit_AVX512F | bit_AVX512DQ | bit_AVX512VL | bit_AVX512BW;
    avx2 = fma && (b & bit_AVX2) && (saved & 0x06) == 0x06;
    avx512 = avx2 && (b & wide) == wide && (saved & 0xe6) == 0xe6;
  }
};
#endif

// The sets this processor runs, the fastest first.
std::vector<InstructionSet> supported() {
  std::vector<InstructionSet> sets;
#if defined(RGBAVATAR_X86)
  const Processor processor;
  if (processor.avx512) sets.push_back({"avx512", &avx512::kernels});
  if (processor.avx2) sets.push_back({"avx2", &avx2::kernels});
#endif
  sets.push_back({"generic", &generic::kernels});
  return sets;
}

}  // namespace

const Kernels* kernels_for(const std::string& name) {
  std::string known;
  for (const InstructionSet& set : supported()) {
    if (name.empty() || name == set.name) return set.kernels;
    known += known.empty() ? set.name : std::string(", ") + set.name;
  }
  throw std::invalid_argument("This processor does not run the instruction set '" + name +
                              "'. Choose one of: " + known + ".");
}

std::vector<std::string> instruction_sets() {
  std::vector<std::string> names;
  for (const InstructionSet& set : supported()) names.push_back(set.name);
  return names;
}

}  // namespace rgbavatar
