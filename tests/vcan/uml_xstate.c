/* Library to preload into User-Mode Linux on processors with AMX.
 *
 * User-Mode Linux 6.1 saves and restores the vector registers of its processes with a buffer that is shorter than the
 * register set of such a processor. The host then refuses to restore the registers, and the guest does not boot. This
 * library uses a buffer of the right length. The registers that do not fit into the buffer of User-Mode Linux are those of
 * AMX. No process of the guest can use AMX, because a process must first request it from its kernel, and this kernel does
 * not know it.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

enum { LARGEST = 1 << 16, COMPONENTS = 512 };     /* COMPONENTS: offset of the bits of the components in use */
static const uint64_t AMX = 3ull << 17;           /* bits of the tile configuration and the tile data */

typedef long (*Ptrace)(enum __ptrace_request, pid_t, void *, void *);

static long transfer(Ptrace real, enum __ptrace_request request, pid_t pid, void *set, struct iovec *given)
{
    static char state[LARGEST];                    /* static, because the stacks of the guest kernel are small */
    struct iovec whole = {state, sizeof state};
    if (real(PTRACE_GETREGSET, pid, set, &whole) < 0)
        return -1;
    if (whole.iov_len <= given->iov_len)
        return real(request, pid, set, given);
    if (request == PTRACE_SETREGSET)
        memcpy(state, given->iov_base, given->iov_len);
    uint64_t components;
    memcpy(&components, state + COMPONENTS, sizeof components);
    components &= ~AMX;
    memcpy(state + COMPONENTS, &components, sizeof components);
    if (request == PTRACE_SETREGSET)
        return real(request, pid, set, &whole);
    memcpy(given->iov_base, state, given->iov_len);
    return 0;
}

long ptrace(enum __ptrace_request request, ...)
{
    static Ptrace real;
    if (!real)
        real = (Ptrace)dlsym(RTLD_NEXT, "ptrace");
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *), *data = va_arg(arguments, void *);
    va_end(arguments);
    if ((request == PTRACE_GETREGSET || request == PTRACE_SETREGSET) && (uintptr_t)address == NT_X86_XSTATE)
        return transfer(real, request, pid, address, data);
    return real(request, pid, address, data);
}
