//! What a frame costs when very much burns: one tracker step on one core, all fires seen in each look.
//!
//! `./x bench track`. The bound is 10 ms for 1,000 fires and ten times that for 10,000; `emberfix eval
//! location --part times` holds the same frames to it.

#![expect(
    clippy::unwrap_used,
    reason = "a benchmark may stop at its first surprise"
)]

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use emberfix::eval::location::speed::Crowd;
use std::time::{Duration, Instant};

/// Looks that are taken in before the clock runs: fires are young then.
const WARM: usize = 3;

fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("track_step");
    group.sample_size(10);
    for fires in [1, 10, 100, 1_000, 10_000] {
        let mut crowd = Crowd::new(fires, 1).unwrap();
        for _ in 0..WARM {
            let look = crowd.draw();
            crowd.take(&look);
        }
        group.throughput(Throughput::Elements(fires as u64));
        group.bench_function(BenchmarkId::from_parameter(fires), |bencher| {
            bencher.iter_custom(|looks| {
                let mut spent = Duration::ZERO;
                for _ in 0..looks {
                    let look = crowd.draw();
                    let start = Instant::now();
                    crowd.take(&look);
                    spent += start.elapsed();
                }
                spent
            });
        });
    }
    group.finish();
}

criterion_group!(benches, step);
criterion_main!(benches);
