//! Memory limits and memory use of this process on Windows.

use std::mem::{size_of, zeroed};

use windows_sys::Win32::System::JobObjects::{
    JOB_OBJECT_LIMIT_JOB_MEMORY, JOB_OBJECT_LIMIT_PROCESS_MEMORY, JOBOBJECT_EXTENDED_LIMIT_INFORMATION,
    JobObjectExtendedLimitInformation, QueryInformationJobObject,
};
use windows_sys::Win32::System::ProcessStatus::{K32GetProcessMemoryInfo, PROCESS_MEMORY_COUNTERS};
use windows_sys::Win32::System::SystemInformation::{GlobalMemoryStatusEx, MEMORYSTATUSEX};
use windows_sys::Win32::System::Threading::GetCurrentProcess;

use crate::{LimitSource, MemoryLimit, MemoryLimits};

/// Returns the physical memory of the machine, and the limits of the job object (group of processes) to which this
/// process belongs.
pub fn memory_limits() -> MemoryLimits {
    let machine = machine_bytes().map(|bytes| MemoryLimit { bytes, source: LimitSource::Machine });
    let job = job_bytes().into_iter().map(|bytes| MemoryLimit { bytes, source: LimitSource::JobObject });
    MemoryLimits { shared: machine.into_iter().chain(job).collect(), process: Vec::new() }
}

/// Returns the physical memory of the machine in bytes, or `None` if the system gives no answer.
fn machine_bytes() -> Option<u64> {
    // SAFETY: all fields are integers.
    let mut status: MEMORYSTATUSEX = unsafe { zeroed() };
    status.dwLength = size_of::<MEMORYSTATUSEX>() as u32;
    // SAFETY: `status` is initialized and states its own size.
    (unsafe { GlobalMemoryStatusEx(&mut status) } != 0).then_some(status.ullTotalPhys)
}

/// Returns the memory limits of the job object of this process in bytes: the limit per process and the limit of the
/// whole job, if they are set. Returns an empty list if the process belongs to no job object.
fn job_bytes() -> Vec<u64> {
    // SAFETY: all fields are integers.
    let mut limits: JOBOBJECT_EXTENDED_LIMIT_INFORMATION = unsafe { zeroed() };
    let size = size_of::<JOBOBJECT_EXTENDED_LIMIT_INFORMATION>() as u32;
    // SAFETY: a null handle means the job of this process; the pointer and the size are those of `limits`.
    let found = unsafe {
        QueryInformationJobObject(
            std::ptr::null_mut(),
            JobObjectExtendedLimitInformation,
            (&raw mut limits).cast(),
            size,
            std::ptr::null_mut(),
        )
    };
    // The call fails if the process belongs to no job.
    let flags = if found == 0 { 0 } else { limits.BasicLimitInformation.LimitFlags };
    let stated = [
        (JOB_OBJECT_LIMIT_PROCESS_MEMORY, limits.ProcessMemoryLimit),
        (JOB_OBJECT_LIMIT_JOB_MEMORY, limits.JobMemoryLimit),
    ];
    stated.into_iter().filter(|(flag, _)| flags & flag != 0).map(|(_, bytes)| bytes as u64).collect()
}

/// Returns the largest working set (physical memory, mapped files included) that this process has had so far, in bytes.
/// Returns `None` if the system gives no answer.
pub fn peak_memory_bytes() -> Option<u64> {
    // SAFETY: all fields are integers.
    let mut counters: PROCESS_MEMORY_COUNTERS = unsafe { zeroed() };
    let size = size_of::<PROCESS_MEMORY_COUNTERS>() as u32;
    // SAFETY: the handle of the own process is always valid; the pointer and the size are those of `counters`.
    let found = unsafe { K32GetProcessMemoryInfo(GetCurrentProcess(), &mut counters, size) };
    (found != 0).then_some(counters.PeakWorkingSetSize as u64)
}

/// Returns false: Windows cannot reset [`peak_memory_bytes`].
pub fn reset_peak_memory() -> bool {
    false
}

/// Does nothing: the allocator of this system decides when it returns freed memory.
pub fn return_freed_memory() {}
