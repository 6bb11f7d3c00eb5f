#include "kernels/waiting.h"

namespace brdfit::kernels {
namespace {

thread_local Waiter* current = nullptr;

}  // namespace

Waiter* waiter_of_thread() { return current; }

WaiterScope::WaiterScope(Waiter& waiter) { current = &waiter; }

WaiterScope::~WaiterScope() { current = nullptr; }

}  // namespace brdfit::kernels
