// A device whose memory is the processor's, but which no other tensor meets: as on a GPU.
#include <ATen/EmptyTensor.h>
#include <ATen/detail/PrivateUse1HooksInterface.h>
#include <ATen/native/CPUFallback.h>
#include <ATen/ops/_reshape_alias_native.h>
#include <ATen/ops/as_strided_cpu_dispatch.h>
#include <ATen/ops/view_native.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/extension.h>

#include <cstdlib>
#include <cstring>

namespace {
constexpr auto kThere = c10::DeviceType::PrivateUse1;

struct Memory final : c10::Allocator {
  c10::DataPtr allocate(size_t bytes) override {
    void* data = bytes ? std::malloc(bytes) : nullptr;
    if (data) std::memset(data, 0xff, bytes);  // Not numbers: who reads what nobody wrote finds out.
    return {data, data, &std::free, c10::Device(kThere, 0)};
  }
  c10::DeleterFnPtr raw_deleter() const override { return &std::free; }
  void copy_data(void* to, const void* from, size_t bytes) const override {
    default_copy_data(to, from, bytes);
  }
} memory;

// The same memory as a tensor of the processor.
at::Tensor here(const at::Tensor& t) {
  if (!t.defined() || t.device().type() != kThere) return t;
  void* data = t.numel() ? t.mutable_data_ptr() : nullptr;
  return at::from_blob(data, t.sizes(), t.strides(), t.options().device(at::kCPU));
}

at::Tensor empty_there(at::IntArrayRef size, std::optional<at::ScalarType> dtype,
                       std::optional<at::Layout>, std::optional<at::Device>, std::optional<bool>,
                       std::optional<at::MemoryFormat> format) {
  return at::detail::empty_generic(size, &memory, c10::DispatchKeySet(c10::DispatchKey::PrivateUse1),
                                   c10::dtype_or_default(dtype), format);
}
at::Tensor empty_strided_there(at::IntArrayRef size, at::IntArrayRef stride,
                               std::optional<at::ScalarType> dtype, std::optional<at::Layout>,
                               std::optional<at::Device>, std::optional<bool>) {
  return at::detail::empty_strided_generic(size, stride, &memory,
                                           c10::DispatchKeySet(c10::DispatchKey::PrivateUse1),
                                           c10::dtype_or_default(dtype));
}
at::Tensor copy_from(const at::Tensor& from, const at::Tensor& to, bool) {
  here(to).copy_(here(from));
  return to;
}
at::Tensor copy_from_and_resize(const at::Tensor& from, const at::Tensor& to) {
  to.resize_(from.sizes());
  return copy_from(from, to, false);
}
at::Tensor as_strided_there(const at::Tensor& t, c10::SymIntArrayRef size, c10::SymIntArrayRef stride,
                            std::optional<c10::SymInt> offset) {
  auto to = offset ? std::optional<int64_t>(offset->expect_int()) : std::nullopt;
  return at::cpu::as_strided(t, C10_AS_INTARRAYREF_SLOW(size), C10_AS_INTARRAYREF_SLOW(stride), to);
}
at::Tensor view_there(const at::Tensor& t, c10::SymIntArrayRef size) {
  return at::native::view(t, C10_AS_INTARRAYREF_SLOW(size));
}
at::Tensor reshape_alias(const at::Tensor& t, c10::SymIntArrayRef size, c10::SymIntArrayRef stride) {
  return at::native::_reshape_alias(t, C10_AS_INTARRAYREF_SLOW(size), C10_AS_INTARRAYREF_SLOW(stride));
}
const at::Tensor& resize_there(const at::Tensor& t, c10::SymIntArrayRef size,
                               std::optional<at::MemoryFormat>) {
  auto sizes = C10_AS_INTARRAYREF_SLOW(size);
  if (t.sizes() == sizes) return t;  // A view keeps its strides.
  auto* impl = t.unsafeGetTensorImpl();
  int64_t count = c10::multiply_integers(sizes) + impl->storage_offset();
  size_t bytes = size_t(count) * t.element_size();
  if (t.storage().nbytes() < bytes) {
    at::DataPtr bigger = memory.allocate(bytes);
    std::memcpy(bigger.get(), t.storage().data(), t.storage().nbytes());
    t.storage().set_data_ptr_noswap(std::move(bigger));
    t.storage().set_nbytes(bytes);
  }
  impl->set_sizes_contiguous(sizes);
  return t;
}
at::Tensor& set_storage(at::Tensor& t, at::Storage source, int64_t offset, at::IntArrayRef size,
                        at::IntArrayRef stride) {
  t.unsafeGetTensorImpl()->set_storage_keep_dtype(source);
  t.unsafeGetTensorImpl()->set_storage_offset(offset);
  t.unsafeGetTensorImpl()->set_sizes_and_strides(size, stride);
  return t;
}
at::Tensor& set_whole_storage(at::Tensor& t, at::Storage source) {
  const int64_t count = int64_t(source.nbytes() / t.element_size());
  return set_storage(t, std::move(source), 0, count, {1});
}
// Made at once: views that remember to be conjugate are not known here.
at::Tensor conjugate(const at::Tensor& t) { return at::conj_physical(t); }
at::Tensor there(const at::Tensor& t) { return t.defined() ? t.to(c10::Device(kThere, 0)) : t; }
at::Tensor convolution(const at::Tensor& input, const at::Tensor& weight,
                       const std::optional<at::Tensor>& bias, at::IntArrayRef stride,
                       at::IntArrayRef padding, at::IntArrayRef dilation, bool transposed,
                       at::IntArrayRef output_padding, int64_t groups) {
  auto added = bias ? std::optional<at::Tensor>(here(*bias)) : std::nullopt;
  return there(at::convolution(here(input), here(weight), added, stride, padding, dilation,
                               transposed, output_padding, groups));
}
std::tuple<at::Tensor, at::Tensor, at::Tensor> convolution_backward(
    const at::Tensor& gradient, const at::Tensor& input, const at::Tensor& weight,
    at::IntArrayRef stride, at::IntArrayRef padding, at::IntArrayRef dilation, bool transposed,
    at::IntArrayRef output_padding, int64_t groups, std::array<bool, 3> wanted) {
  auto found = at::convolution_backward(here(gradient), here(input), here(weight), std::nullopt,
                                        stride, padding, dilation, transposed, output_padding,
                                        groups, {wanted[0], wanted[1], false});
  return {there(std::get<0>(found)), there(std::get<1>(found)), at::Tensor()};
}
at::Scalar number_of(const at::Tensor& t) { return here(t).item(); }

// Everything else is computed by the processor, of tensors that are all there.
void anything(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  const auto name = op.schema().operator_name().name;
  const bool chooses = name == "aten::index" || name == "aten::index_put_" ||
                       name == "aten::_index_put_impl_" || name == "aten::index_put";
  const auto count = op.schema().arguments().size();
  const auto arguments = torch::jit::last(*stack, count);
  auto look = [&](const at::Tensor& t) {
    TORCH_CHECK(!t.defined() || t.device().type() == kThere || t.dim() == 0 || chooses, name,
                ": expected all tensors to be on the same device, but found one in main memory");
  };
  for (const auto& argument : arguments) {
    if (argument.isTensor()) look(argument.toTensor());
    if (argument.isTensorList())
      for (const at::Tensor& t : argument.toTensorList()) look(t);
  }
  at::native::cpu_fallback(op, stack);
}

struct Hooks final : at::PrivateUse1HooksInterface {
  bool isAvailable() const override { return true; }
  bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
  bool isBuilt() const override { return true; }
  c10::DeviceIndex deviceCount() const override { return 1; }
  c10::DeviceIndex getCurrentDevice() const override { return 0; }
} hooks;

// One stream, in which work is done before it can be waited for.
struct Guard final : c10::impl::NoOpDeviceGuardImpl<kThere> {
  static c10::Stream only() { return c10::Stream(c10::Stream::DEFAULT, c10::Device(kThere, 0)); }
  c10::Device getDevice() const override { return {kThere, 0}; }
  c10::Device exchangeDevice(c10::Device) const override { return {kThere, 0}; }
  c10::Stream getStream(c10::Device) const noexcept override { return only(); }
  c10::Stream exchangeStream(c10::Stream) const noexcept override { return only(); }
  void record(void**, const c10::Stream&, c10::DeviceIndex, c10::EventFlag) const override {}
  void block(void*, const c10::Stream&) const override {}
  bool queryEvent(void*) const override { return true; }
  void destroyEvent(void*, c10::DeviceIndex) const noexcept override {}
};
}  // namespace

C10_REGISTER_GUARD_IMPL(PrivateUse1, Guard);
TORCH_LIBRARY_IMPL(aten, PrivateUse1, m) {
  m.impl("empty.memory_format", empty_there);
  m.impl("empty_strided", empty_strided_there);
  m.impl("_copy_from", copy_from);
  m.impl("_copy_from_and_resize", copy_from_and_resize);
  m.impl("as_strided", as_strided_there);
  m.impl("view", view_there);
  m.impl("_reshape_alias", reshape_alias);
  m.impl("resize_", resize_there);
  m.impl("set_.source_Storage_storage_offset", set_storage);
  m.impl("set_.source_Storage", set_whole_storage);
  m.impl("_conj", conjugate);
  m.impl("convolution_overrideable", convolution);
  m.impl("convolution_backward_overrideable", convolution_backward);
  m.impl("_local_scalar_dense", number_of);
}
TORCH_LIBRARY_IMPL(_, PrivateUse1, m) {
  m.fallback(torch::CppFunction::makeFromBoxedFunction<&anything>());
}
PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) { at::RegisterPrivateUse1HooksInterface(&hooks); }
