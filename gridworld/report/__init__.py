"""Many runs side by side: statistics over seeds, as one page, as figures and tables, and for TensorBoard.

    evidence, tuning_study -> grouping -> statistics, analysis -> tables, charts -> page -> writer

The statistics are those of R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, "Deep
Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021: interquartile means,
stratified bootstrap intervals, probabilities of improvement. rliable, the authors' own library, cannot be
imported beside pandas 3 (its dependency arch fails).
"""
