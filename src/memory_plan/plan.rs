//! Choice of limits that keep all stages of a run within its memory budget.

use std::fmt::Write as _;

use super::budget::{Budget, PER_THREAD, PROGRAM_BYTES, Verbosity, size};
use super::estimate::{ResourceEstimate, seconds};
use super::workload::{MemoryPart, Workload};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::passes::VIEWS_PER_THREAD;
use crate::progress::{Events, Message, duration};

/// Divisor of the memory budget: all decoded tiles of a container (values of consecutive Gaussians × frames) stay in
/// memory if they take at most 1/16 of the budget. The file system caches the stored bytes anyway. A larger part would
/// leave less memory to other processes and save no more than decoding time.
const HELD_TILES_DIVISOR: u64 = 16;

/// Functions that each halve one limit. Halving a limit slows a run; the functions that slow it most come first. If
/// several free equally much memory, the last of them is chosen.
const HALVINGS: [fn(&Limits) -> Limits; 5] = [
    |limits| Limits { pictures_together: limits.pictures_together.div_ceil(2), ..*limits },
    |limits| Limits { pairs_together: limits.pairs_together.div_ceil(2), ..*limits },
    |limits| Limits { gaussians_together: (limits.gaussians_together / 2).max(GAUSSIAN_BLOCK), ..*limits },
    |limits| Limits { frames_together: limits.frames_together.div_ceil(2), ..*limits },
    |limits| Limits { frames_held: limits.frames_held.div_ceil(2), ..*limits },
];

/// Limits by which a run stays within its memory budget, and the estimates of its stages under these limits.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    work: Workload,
    budget: u64,
    /// Maximum amounts (frames, views, Gaussians) that stages keep in memory at a time.
    pub limits: Limits,
    estimates: Vec<ResourceEstimate>,
}

impl Plan {
    /// Finds the fastest limits with which all stages fit into `budget`. `estimates` returns the estimates of all
    /// stages for given limits. Sends the plan as text to `events` if the budget asks for it, even if the stages do not
    /// fit.
    ///
    /// # Errors
    /// Fails if the stages do not fit under any limits; the error states the smallest sufficient budget.
    pub fn fit(
        work: Workload,
        budget: Budget,
        events: &Events,
        estimates: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<Plan> {
        let plan = Self::closest(work, budget.limit(), estimates);
        let fits = plan.excess_bytes() == 0;
        if budget.tell == Verbosity::Plan {
            events.send(Message::Plan(format!("budget: {}\n{}", budget.named(), plan.text()).trim_end()));
        }
        if fits { Ok(plan) } else { Err(plan.too_small_error(budget)) }
    }

    /// Returns whether there are limits with which all stages that `estimates` describes fit into `budget`.
    pub fn fits(
        work: Workload,
        budget: Budget,
        estimates: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> bool {
        Self::closest(work, budget.limit(), estimates).excess_bytes() == 0
    }

    /// Returns the plan of the fastest limits with which all stages fit into `budget` (bytes). If there are none,
    /// returns the plan that takes the least memory.
    pub(crate) fn closest(
        work: Workload,
        budget: u64,
        estimates: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Plan {
        let mut limits = Limits {
            frames_held: FRAME_BLOCK,
            frames_together: VIEWS_PER_THREAD * work.threads as usize,
            pictures_together: work.threads as usize,
            gaussians_together: work.gaussians.max(GAUSSIAN_BLOCK as u64) as usize,
            pairs_together: 8 * work.gaussians.max(1) as usize,
            rows_aside: false,
            tiles_held: false,
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
            let limits = Limits { rows_aside, ..limits };
            Plan { work, budget, limits, estimates: all(&limits) }.excess_bytes()
        });
        limits.rows_aside = less < excess_bytes;
        loop {
            let plan = Plan { work, budget, limits, estimates: all(&limits) };
            let excess_bytes = plan.excess_bytes();
            let saved_bytes = |other: &Limits| {
                excess_bytes - Plan { limits: *other, estimates: all(other), ..plan.clone() }.excess_bytes()
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

    /// Allows all decoded tiles of the container to stay in memory if they take a small part of the budget. No tile is
    /// then read twice.
    fn with_held_tiles(mut self) -> Plan {
        let decoded = self.work.input.decoded;
        let fits = self.excess_bytes() == 0 && self.peak().saturating_add(decoded) <= self.budget;
        self.limits.tiles_held = decoded > 0 && fits && decoded <= self.budget / HELD_TILES_DIVISOR;
        self
    }

    /// Returns how many times all stages together read the input in full, at most.
    pub fn reads(&self) -> f64 {
        let sum: f64 = self.estimates.iter().map(|estimate| estimate.reads).sum();
        if self.limits.tiles_held { sum.min(1.0) } else { sum }
    }

    /// Returns the peak memory of the run in bytes: that of the stage that takes most.
    pub fn peak(&self) -> u64 {
        self.base() + self.estimates.iter().map(|estimate| estimate.bytes(&self.work)).max().unwrap_or(0)
    }

    /// Returns the bytes of memory that are taken in every stage: program, threads, index, time stamps, cameras,
    /// decoded tiles.
    fn base(&self) -> u64 {
        let held = if self.limits.tiles_held { self.work.input.decoded } else { 0 };
        PROGRAM_BYTES + PER_THREAD * self.work.threads + self.work.known_bytes() + held
    }

    /// Returns the number of bytes by which each stage exceeds the memory budget, summed over all stages.
    fn excess_bytes(&self) -> u64 {
        let available = self.budget.saturating_sub(self.base());
        let beyond = self.estimates.iter().map(|estimate| estimate.bytes(&self.work).saturating_sub(available));
        beyond.sum::<u64>() + self.base().saturating_sub(self.budget)
    }

    /// Returns the error for a memory budget that is too small; it states the smallest sufficient one.
    fn too_small_error(&self, budget: Budget) -> Error {
        let largest = self
            .estimates
            .iter()
            .max_by_key(|estimate| estimate.bytes(&self.work))
            .map_or("", |estimate| estimate.stage);
        // Rounded up to whole MiB, since the user will write it so.
        let least = self.peak().div_ceil(1 << 20);
        let origin = if budget.bytes.is_none() { format!(" ({})", Budget::by_default().1) } else { String::new() };
        Error::MemoryLimit(format!(
            "--memory {}{origin}: expected at least {least}MiB, which the stage \"{largest}\" takes for {} Gaussians{}\n  \
             raise --memory to that or lower --threads; --explain lists the memory of every stage",
            size(self.budget),
            self.work.gaussians,
            if self.work.frames > 0 { format!(" x {} frames", self.work.frames) } else { String::new() }
        ))
    }

    /// Returns the plan as text: the memory of each stage by its named parts, the limits, and the full reads of the
    /// input.
    pub fn text(&self) -> String {
        let Plan { work, limits, .. } = self;
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "memory: at most {} of {} for {} Gaussians x {} frames, {} views, {} threads",
            size(self.peak()),
            size(self.budget),
            work.gaussians,
            work.frames,
            work.pictures,
            work.threads
        );
        let _ = writeln!(
            out,
            "  = {} program and threads + {} frames, cameras, index + {} tiles held + the largest stage:",
            size(PROGRAM_BYTES + PER_THREAD * work.threads),
            size(work.known_bytes()),
            size(self.base() - PROGRAM_BYTES - PER_THREAD * work.threads - work.known_bytes())
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
                size(estimate.bytes(work)),
                work.input.per_gaussian + estimate.bytes_per_gaussian(),
                parts(&per_gaussian, |bytes| bytes.to_string()),
                parts(&estimate.fixed, size)
            );
        }
        let _ = writeln!(
            out,
            "  at a time: {} frames held by readers, {} frames ready, {} views, {} pairs measured",
            limits.frames_held.min(work.input.frame_block as usize),
            limits.frames_together,
            limits.pictures_together,
            limits.pairs_together
        );
        let reads = self.estimates.iter().filter(|estimate| estimate.reads > 0.0);
        let named: Vec<String> = reads.map(|estimate| format!("{:.2} {}", estimate.reads, estimate.stage)).collect();
        let held = if limits.tiles_held { "all decoded tiles stay in memory; otherwise " } else { "" };
        let named = named.join(" + ");
        let _ = writeln!(out, "full reads of the input: at most {:.2} ({held}{named})", self.reads());
        out
    }

    /// Sends the estimated time of each stage to `events` if `tell` asks for the whole plan.
    pub fn tell_time(&self, tell: Verbosity, events: &Events) {
        if tell == Verbosity::Plan {
            let stages = seconds(&self.work, &self.estimates);
            let whole: f64 = stages.iter().map(|(_, seconds)| seconds).sum();
            let named = stages.iter().map(|(stage, seconds)| format!("{} {stage}", duration(*seconds)));
            let text = format!("time: about {} ({})", duration(whole), named.collect::<Vec<_>>().join(" + "));
            events.send(Message::Plan(&text));
        }
    }
}
