//! Compresses a scene and shows its progress with its own event handler: one line per task, with the percentage done.
//!
//! ```sh
//! cargo run --release --example compress -- output/my_model small    # keeps 10% of the Gaussians
//! ```

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use splatsieve::cache::Completion;
use splatsieve::pipeline::{Request, Target, compress};
use splatsieve::progress::{EventSink, Events, Message, Task, TaskSink};
use splatsieve::recipe::Recipe;
use splatsieve::scene::InputOptions;

/// Event handler that prints on standard output.
struct Printer;

impl EventSink for Printer {
    fn run_begun(&self, stages: &[&'static str]) {
        println!("stages: {}", stages.join(", "));
    }

    fn task_begun(&self, task: Task<'_>) -> Option<Box<dyn TaskSink>> {
        Some(Box::new(Percentage { name: task.name, total: task.total, done: AtomicU64::new(0) }))
    }

    fn message(&self, message: Message<'_>) {
        match message {
            Message::Plan(text) | Message::Warning(text) => println!("{text}"),
            Message::Discarded { stage, why } => println!("{stage} is left out: {why}"),
        }
    }
}

/// Task whose progress is printed in steps of 10%.
#[derive(Debug)]
struct Percentage {
    name: &'static str,
    total: Option<u64>,
    done: AtomicU64,
}

impl TaskSink for Percentage {
    fn advanced(&self, units: u64) {
        let before = self.done.fetch_add(units, Ordering::Relaxed);
        let Some(total) = self.total.filter(|&total| total > 0) else { return };
        let tenth = |done: u64| 10 * done / total;
        if tenth(before + units) > tenth(before) {
            println!("{}: {} %", self.name, 10 * tenth(before + units));
        }
    }

    fn restarted(&mut self, total: u64) {
        (self.total, self.done) = (Some(total), AtomicU64::new(0));
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [input, output] = &arguments[..] else { return Err("expected two arguments: INPUT OUTPUT".into()) };
    let input = InputOptions { path: input.clone(), events: Events::new(Printer), ..InputOptions::default() };
    let request =
        Request { target: Some(Target::Ratio(0.1)), ..Request::new(input, output.clone(), Recipe::preset("default")?) };
    match compress(&request)? {
        Completion::Whole(summary) => println!("{} Gaussians, {} bytes", summary.gaussians, summary.output_bytes),
        Completion::Shard(shard) => println!("{shard}"),
    }
    Ok(())
}
