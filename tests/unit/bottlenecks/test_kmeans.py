import torch

from repdib_lightning.bottlenecks.kmeans import kmeans, spread_seeds


def blobs(groups, clusters, rows):
    torch.manual_seed(1)
    centres = 10 * torch.randn(groups, clusters, 4)
    member = torch.arange(rows) % clusters
    return centres, centres[:, member] + 0.01 * torch.randn(groups, rows, 4)


def test_finds_the_clusters_of_every_group():
    true, points = blobs(groups=3, clusters=6, rows=300)
    found, shares = kmeans(points, 6)
    for group in range(3):
        nearest = torch.cdist(true[group], found[group]).min(dim=1)
        assert nearest.values.max() < 0.05
        assert sorted(nearest.indices.tolist()) == list(range(6))
    torch.testing.assert_close(shares, torch.full((3, 6), 1 / 6))


def test_same_seed_same_result():
    _, points = blobs(groups=2, clusters=9, rows=200)
    results = []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        results.append(kmeans(points, 7)[0])
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_iterations_lower_the_error():
    points = torch.randn(2, 400, 3)

    def error(iterations):
        torch.manual_seed(0)
        centres, _ = kmeans(points, 8, iterations=iterations)
        return torch.cdist(points, centres).min(-1).values.square().mean()

    assert error(10) < error(1) < error(0)


def test_fewer_points_than_clusters():
    points = torch.randn(2, 3, 4)
    centres, shares = kmeans(points, 5)
    assert torch.isfinite(centres).all()
    torch.testing.assert_close(shares.sum(-1), torch.ones(2))
    assert torch.cdist(points, centres).min(-1).values.max() < 1e-3


def test_seeds_are_points():
    points = torch.randn(2, 50, 4)
    seeds = spread_seeds(points, 10)
    for group in range(2):
        matches = (seeds[group].unsqueeze(1) == points[group].unsqueeze(0)).all(-1)
        assert matches.any(1).all()
        assert len(seeds[group].unique(dim=0)) == 10
