//! Implementation for macOS: memory limits, and functions that have no effect because macOS does not support them. The
//! code is type-checked but not tested.

use std::mem::{MaybeUninit, size_of};

use rustix::process::{Resource, getrlimit};

use crate::{LimitSource, MemoryLimit, MemoryLimits, TruncatedMapMessage};

/// Does nothing. macOS gives a process no information on the file that a page belongs to, so the signal SIGBUS, sent
/// after a mapped file was truncated, ends the process.
pub fn report_truncated_maps(_message: TruncatedMapMessage) {}

/// Returns the physical memory of the machine and the limits that `ulimit` sets for the process.
pub fn memory_limits() -> MemoryLimits {
    let machine = machine_bytes().map(|bytes| MemoryLimit { bytes, source: LimitSource::Machine });
    let own = [(Resource::As, LimitSource::AddressSpace), (Resource::Data, LimitSource::DataSize)];
    let own = own.into_iter().filter_map(|(resource, source)| {
        let bytes = getrlimit(resource).current?;
        Some(MemoryLimit { bytes, source })
    });
    MemoryLimits { shared: machine.into_iter().collect(), process: own.collect() }
}

/// Returns the physical memory of the machine in bytes, or `None` if the system gives no answer.
fn machine_bytes() -> Option<u64> {
    let mut bytes = 0u64;
    let mut size = size_of::<u64>();
    // SAFETY: the name ends with a zero byte; the pointer and the size are those of `bytes`; no new value is set.
    let code = unsafe {
        libc::sysctlbyname(c"hw.memsize".as_ptr(), (&raw mut bytes).cast(), &raw mut size, std::ptr::null_mut(), 0)
    };
    (code == 0 && size == size_of::<u64>()).then_some(bytes)
}

/// Returns the largest resident memory (in physical memory, mapped files included) that this process has had so far, in
/// bytes. Returns `None` if the system gives no answer.
pub fn peak_memory_bytes() -> Option<u64> {
    let mut usage = MaybeUninit::<libc::rusage>::uninit();
    // SAFETY: the call writes to `usage`, which has the expected size and alignment. `usage` is read only if the call
    // reports success.
    let usage = unsafe { (libc::getrusage(libc::RUSAGE_SELF, usage.as_mut_ptr()) == 0).then(|| usage.assume_init()) }?;
    u64::try_from(usage.ru_maxrss).ok()
}

/// Returns false: macOS cannot reset [`peak_memory_bytes`].
pub fn reset_peak_memory() -> bool {
    false
}

/// Does nothing: the allocator of this system decides when it returns freed memory.
pub fn return_freed_memory() {}
