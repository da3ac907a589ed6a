//! Random order in which optimization steps use the training views.

use crate::scene::views_between::SplitMix64;

/// Random order in which training views are used. Each epoch takes all of them once, in a new order.
pub(super) struct EpochSampler {
    views: Vec<usize>,
    at: usize,
    random: SplitMix64,
    /// Number of views taken from the random order so far, over all epochs.
    pub(super) taken: usize,
}

impl EpochSampler {
    pub(super) fn new(views: Vec<usize>) -> EpochSampler {
        EpochSampler { at: views.len(), views, random: SplitMix64(1), taken: 0 }
    }

    pub(super) fn next(&mut self) -> usize {
        let view = self.peek();
        self.at += 1;
        self.taken += 1;
        view
    }

    /// Returns the view that [`EpochSampler::next`] will return.
    pub(super) fn peek(&mut self) -> usize {
        if self.at == self.views.len() {
            self.random.shuffle(&mut self.views);
            self.at = 0;
        }
        self.views[self.at]
    }

    /// Skips views of the random order until `steps` views have been taken since the beginning. Used to continue an
    /// interrupted run.
    pub(super) fn skip_to(&mut self, steps: usize) {
        while self.taken < steps {
            self.next();
        }
    }
}
