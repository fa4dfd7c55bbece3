"""The report's page, to be filled in."""

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>CaRTS benchmark</title>
<style>$style</style>
</head>
<body>
<h1>CaRTS benchmark</h1>
$facts
<nav><a href="#targets">Targets</a> <a href="#figures">Figures</a> $contents
<a href="#method">How it is measured</a></nav>
<section id="targets"><h2>Targets</h2>
<p>Of the default solver. Target, figure and verdict are computed from the runs of this report; the line below each says
from how many. One that lacks a domain or a device it asks for is open. From 2 or 3 runs, as in the quick form, a
verdict may be chance.</p>
<div class="wide">$targets</div></section>
<section id="figures"><h2>Figures</h2>$figures</section>
$sections
<section id="method"><h2>How it is measured</h2>
<p>Every method gets the same image, the same mean background and the same wrong joint positions of a frame, and works
on that frame alone, in one camera, unless a table says otherwise. Its mask is drawn by the renderer at the camera's
size from the joint positions that it returns (the U-Net's is its own) and compared with the given mask.</p>
<p><b>Dice</b>: overlap of the masks. <b>NSD</b>: share of both masks' outlines within $tolerance px of each other.
<b>Joint MAE</b>: mean absolute error of the measured revolute joints of all arms.</p>
<p><b>Paper's setting</b>: Adam with step size 1e-3, times 0.9 every 5 steps, the paper's form of the loss, no prior,
with our renderer and network. It is not the original implementation, whose renderer has no silhouette gradient.
<b>Best of n</b>: the iterate of the lowest loss among the first n steps, the start included.</p>
<p><b>Synthetic frames</b> are path-traced and were made for this benchmark, with a seed that nothing was tuned on.
<b>Real frames</b> are altered in memory: blood, smoke and low light by the code of the synthetic domains, over the
depth of the arms as measured before a plane; another background by compositing with the given masks.</p>
<p><b>Occluders</b> are laid over regular frames, synthetic and real ones: gauze, tissue or cloth with its own texture,
folds and a soft shadow. Nothing is compared where they are. <i>Proposed</i>: a first solution, then a second one
without the areas at the arms that contradict the first.</p>
<p>Small grey numbers are the paper's, after the column where they stand there (R: its real recording, S: its synthetic
one). They were taken on its own recordings, so they show trends and are no race: $source.</p>
</section>
</body>
</html>
"""
