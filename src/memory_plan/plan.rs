//! Choice of limits that keep all stages of a run within its memory budget.

use std::fmt::Write as _;

use super::budget::{Budget, PER_THREAD, PROGRAM_BYTES, Verbosity, format_bytes};
use super::estimate::ResourceEstimate;
use super::workload::{MemoryPart, Workload};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::passes::VIEWS_PER_THREAD;
use crate::progress::{Events, Message, counted, format_duration};

/// Decoded tiles of a container may take at most the memory budget divided by this number. A tile holds the values of
/// consecutive Gaussians at consecutive frames.
/// - If all decoded tiles together take no more than that, they stay in memory.
/// - If they take more, each tile is decoded again whenever it is needed. The file system caches the stored bytes
///   anyway.
///
/// More memory for tiles would thus save only decoding time, and leave less memory to other processes.
const HELD_TILES_DIVISOR: u64 = 16;

/// Functions that reduce the memory of a run. Each halves one limit on what stages keep in memory at a time, which
/// slows the run. They are sorted from the one that slows the run most to the one that slows it least. If several free
/// equally much memory, the last of these is chosen.
const HALVINGS: [fn(&Limits) -> Limits; 5] = [
    |limits| Limits { views_together: limits.views_together.div_ceil(2), ..*limits },
    |limits| Limits { pairs_together: limits.pairs_together.div_ceil(2), ..*limits },
    |limits| Limits { gaussians_together: (limits.gaussians_together / 2).max(GAUSSIAN_BLOCK), ..*limits },
    |limits| Limits { frames_together: limits.frames_together.div_ceil(2), ..*limits },
    |limits| Limits { max_kept_frames: limits.max_kept_frames.div_ceil(2), ..*limits },
];

/// Limits by which a run stays within its memory budget, and the estimates of its stages under these limits.
#[derive(Debug, Clone, PartialEq)]
pub struct MemoryPlan {
    work: Workload,
    budget: u64,
    /// Maximum amounts (frames, views, Gaussians) that stages keep in memory at a time.
    pub limits: Limits,
    estimates: Vec<ResourceEstimate>,
}

impl MemoryPlan {
    /// Finds the fastest limits under which all stages of a run on the input `work` fit into the memory budget
    /// `budget`, and returns the plan with these limits. `estimates` returns the estimates of all stages for given
    /// limits. Sends the plan as text to `events` if the user asked for it ([`Verbosity::Plan`]), even if the stages do
    /// not fit.
    ///
    /// # Errors
    /// Fails if the stages do not fit under any limits; the error states the smallest sufficient budget.
    pub fn fit_budget(
        work: Workload,
        budget: Budget,
        events: &Events,
        estimates: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<MemoryPlan> {
        let plan = Self::closest(work, budget.limit(), estimates);
        let fits = plan.excess_bytes() == 0;
        if budget.tell == Verbosity::Plan {
            events.send(Message::Plan(format!("budget: {}\n{}", budget.text(), plan.text()).trim_end()));
        }
        if fits { Ok(plan) } else { Err(plan.too_small_error(budget)) }
    }

    /// Returns whether there are limits under which all stages of a run on the input `work` fit into the memory budget
    /// `budget`. A limit is a maximum amount (frames, views, Gaussians; see [`Limits`]) that stages keep in memory at a
    /// time. `estimates` returns the estimates of all stages for given limits.
    pub fn fits_budget(
        work: Workload,
        budget: Budget,
        estimates: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> bool {
        Self::closest(work, budget.limit(), estimates).excess_bytes() == 0
    }

    /// Returns the fastest plan for a run on the input `work` in which every stage fits into `budget` bytes; if there
    /// is none, the plan that takes the least memory. `estimates` returns the estimates of all stages for given limits.
    pub(crate) fn closest(
        work: Workload,
        budget: u64,
        estimates: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> MemoryPlan {
        let mut limits = Limits {
            max_kept_frames: FRAME_BLOCK,
            frames_together: VIEWS_PER_THREAD * work.threads as usize,
            views_together: work.threads as usize,
            gaussians_together: work.gaussians.max(GAUSSIAN_BLOCK as u64) as usize,
            pairs_together: 8 * work.gaussians.max(1) as usize,
            statistics_on_disk: false,
            keeps_tiles: false,
        };
        // The input is read entirely before anything else, if its model format requires this.
        let opening = vec![("file", work.input.opening)];
        let opening_read =
            ResourceEstimate { stage: "read", reads: 0.0, seconds: 0.0, per_gaussian: opening, fixed: Vec::new() };
        let all = |limits: &Limits| {
            let first = Some(opening_read.clone()).filter(|_| work.input.opening > 0);
            first.into_iter().chain(estimates(&work, limits)).collect::<Vec<ResourceEstimate>>()
        };
        // Moving statistics to a scratch file costs almost no time, so this is decided first.
        let [excess_bytes, less] = [false, true].map(|rows_aside| {
            let limits = Limits { statistics_on_disk: rows_aside, ..limits };
            MemoryPlan { work, budget, limits, estimates: all(&limits) }.excess_bytes()
        });
        limits.statistics_on_disk = less < excess_bytes;
        loop {
            let plan = MemoryPlan { work, budget, limits, estimates: all(&limits) };
            let excess_bytes = plan.excess_bytes();
            let saved_bytes = |other: &Limits| {
                excess_bytes - MemoryPlan { limits: *other, estimates: all(other), ..plan.clone() }.excess_bytes()
            };
            let halved = HALVINGS.iter().filter_map(|halve| {
                let smaller = std::iter::successors(Some(limits), |limits| Some(halve(limits)));
                smaller.take(usize::BITS as usize).find(|other| saved_bytes(other) > 0)
            });
            // Of several halvings that free equally much memory, the last one is taken: it slows the run least.
            match halved.max_by_key(saved_bytes) {
                Some(other) => limits = other,
                None => return plan.with_held_tiles(),
            }
        }
    }

    /// Returns this plan, with [`Limits::keeps_tiles`] set if all decoded tiles of the container may stay in memory, so
    /// that no tile is read twice. A tile holds the values of consecutive Gaussians at consecutive frames. Tiles may
    /// stay under two conditions:
    /// - All stages and the decoded tiles together fit into the memory budget.
    /// - The decoded tiles take at most the budget divided by [`HELD_TILES_DIVISOR`].
    fn with_held_tiles(mut self) -> MemoryPlan {
        let decoded = self.work.input.decoded;
        let fits = self.excess_bytes() == 0 && self.peak_bytes().saturating_add(decoded) <= self.budget;
        self.limits.keeps_tiles = decoded > 0 && fits && decoded <= self.budget / HELD_TILES_DIVISOR;
        self
    }

    /// Returns the maximum number of times that the whole input is read, summed over all stages. It is at most 1 if all
    /// decoded tiles (stored blocks of the input) stay in memory.
    pub fn whole_input_reads(&self) -> f64 {
        let sum: f64 = self.estimates.iter().map(|estimate| estimate.reads).sum();
        if self.limits.keeps_tiles { sum.min(1.0) } else { sum }
    }

    /// Returns the peak memory of the run in bytes, which is the memory during the stage that takes most.
    pub fn peak_bytes(&self) -> u64 {
        self.base_bytes() + self.estimates.iter().map(|estimate| estimate.bytes(&self.work)).max().unwrap_or(0)
    }

    /// Returns the bytes of memory that are taken throughout the run, whichever stage runs: program, threads, index,
    /// time stamps, cameras, and decoded tiles that stay in memory.
    fn base_bytes(&self) -> u64 {
        let held = if self.limits.keeps_tiles { self.work.input.decoded } else { 0 };
        PROGRAM_BYTES + PER_THREAD * self.work.threads + self.work.known_bytes() + held
    }

    /// Returns a number of bytes that is 0 if all stages fit into the budget, and that shrinks as the plan gets closer
    /// to the budget: the bytes by which each stage exceeds it, summed over all stages, plus the bytes by which
    /// [`MemoryPlan::base_bytes`] (memory that is taken throughout the run) exceeds it.
    fn excess_bytes(&self) -> u64 {
        let available = self.budget.saturating_sub(self.base_bytes());
        let beyond = self.estimates.iter().map(|estimate| estimate.bytes(&self.work).saturating_sub(available));
        beyond.sum::<u64>() + self.base_bytes().saturating_sub(self.budget)
    }

    /// Returns the error for a memory budget that is too small. It states the smallest sufficient budget.
    fn too_small_error(&self, budget: Budget) -> Error {
        let largest = self
            .estimates
            .iter()
            .max_by_key(|estimate| estimate.bytes(&self.work))
            .map_or("", |estimate| estimate.stage);
        // Rounded up to whole MiB, since the user will write it so.
        let least = self.peak_bytes().div_ceil(1 << 20);
        let origin = if budget.bytes.is_none() { format!(" ({})", Budget::by_default().1) } else { String::new() };
        Error::MemoryLimit(format!(
            "--memory {}{origin}: expected at least {least}MiB, which the stage \"{largest}\" takes for {} Gaussians{}\n  \
             raise --memory to that or lower --threads; --explain lists the memory of every stage",
            format_bytes(self.budget),
            self.work.gaussians,
            if self.work.frames > 0 {
                format!(" x {}", counted(self.work.frames as usize, "frame"))
            } else {
                String::new()
            }
        ))
    }

    /// Returns the plan as text: the memory of each stage by its named parts, the limits, and the number of times that
    /// the whole input is read.
    pub fn text(&self) -> String {
        let MemoryPlan { work, limits, .. } = self;
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "memory: at most {} of {} for {} Gaussians x {}, {}, {}",
            format_bytes(self.peak_bytes()),
            format_bytes(self.budget),
            work.gaussians,
            counted(work.frames as usize, "frame"),
            counted(work.frame_views as usize, "view"),
            counted(work.threads as usize, "thread")
        );
        let _ = writeln!(
            out,
            "  = {} program and threads + {} frames, cameras, index + {} decoded tiles + the largest stage:",
            format_bytes(PROGRAM_BYTES + PER_THREAD * work.threads),
            format_bytes(work.known_bytes()),
            format_bytes(self.base_bytes() - PROGRAM_BYTES - PER_THREAD * work.threads - work.known_bytes())
        );
        for estimate in &self.estimates {
            let parts = |parts: &[MemoryPart], unit: fn(u64) -> String| -> String {
                let used = parts.iter().filter(|&&(_, bytes)| bytes > 0);
                used.map(|&(name, bytes)| format!("{} {name}", unit(bytes))).collect::<Vec<_>>().join(" + ")
            };
            let input = [("input", work.input.per_gaussian)];
            let per_gaussian = [&input[..], &estimate.per_gaussian].concat();
            let _ = writeln!(
                out,
                "  {:<8} {:>11} = N x {} ({}) + {}",
                estimate.stage,
                format_bytes(estimate.bytes(work)),
                work.input.per_gaussian + estimate.bytes_per_gaussian(),
                parts(&per_gaussian, |bytes| bytes.to_string()),
                parts(&estimate.fixed, format_bytes)
            );
        }
        let _ = writeln!(
            out,
            "  at a time: {} frames held by readers, {} frames ready, {} views, {} pairs measured",
            limits.max_kept_frames.min(work.input.frame_block as usize),
            limits.frames_together,
            limits.views_together,
            limits.pairs_together
        );
        let reads = self.estimates.iter().filter(|estimate| estimate.reads > 0.0);
        let named: Vec<String> = reads.map(|estimate| format!("{:.2} {}", estimate.reads, estimate.stage)).collect();
        let held = if limits.keeps_tiles { "all decoded tiles stay in memory; otherwise " } else { "" };
        let named = named.join(" + ");
        let _ = writeln!(out, "full reads of the input: at most {:.2} ({held}{named})", self.whole_input_reads());
        out
    }

    /// Sends the estimated time of each stage to `events` if `tell` asks for the whole plan ([`Verbosity::Plan`]).
    pub fn send_stage_times(&self, tell: Verbosity, events: &Events) {
        if tell == Verbosity::Plan {
            // All threads share the work.
            let duration = |core_seconds: f64| format_duration(core_seconds / self.work.threads as f64);
            let whole = duration(self.estimates.iter().map(|estimate| estimate.seconds).sum());
            let stages = self.estimates.iter().map(|stage| format!("{} {}", duration(stage.seconds), stage.stage));
            let text = format!("time: about {whole} ({})", stages.collect::<Vec<_>>().join(" + "));
            events.send(Message::Plan(&text));
        }
    }
}
